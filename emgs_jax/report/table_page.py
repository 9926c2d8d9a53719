"""A page of several runs: report.html with tables and small pictures, without a program or a request."""

import os
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

from PIL import Image

from emgs_jax.io.files import atomic_write
from emgs_jax.report.columns import MAIN, Column, cell
from emgs_jax.report.page import POLICY, filled, source
from emgs_jax.report.page_pictures import jpeg
from emgs_jax.report.page_words import licence_words
from emgs_jax.report.provenance import RAW_PRIOR
from emgs_jax.report.recorded_run import REPORT_FILE

PICTURE_BYTES = 3_500_000  # of base64, all of them together; a page stays below 5 MB
MAX_LINES = 500  # of a table, for the same reason
_WIDTHS = (360, 240, 160, 100)  # pixels


def write_page(folder: Path, title: str, head: str, sections: Sequence[str], names: Iterable[tuple[str, str]]) -> Path:
    """Write report.html into a folder.

    Args:
        folder: of an evaluation or sweep.
        title: of the window.
        head: HTML, above everything.
        sections: HTML.
        names: data sets and priors whose licences are named.

    Returns:
        The path of the page.
    """
    parts = {
        "policy": POLICY,
        "title": escape(title),
        "style": f"{source('page.css')}\n{source('table.css')}",
        "head": head,
        "main": "".join(sections),
        "footer": "".join(licence_words(*name) for name in names),
        "programs": "",
    }
    with atomic_write(folder / REPORT_FILE) as handle:
        handle.write(filled(source("shell.html"), parts).encode())
    return folder / REPORT_FILE


def rows_of(titles: Sequence[str], numbers: Sequence[str], lines: Iterable[str]) -> str:
    """A table of lines that are cells of HTML: first those of texts and pictures, then those of numbers."""
    top = "".join(f'<th class="text">{escape(title)}</th>' for title in titles)
    top += "".join(f"<th>{escape(title)}</th>" for title in numbers)
    return f"<table><tr>{top}</tr>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


def texts(words: Iterable[str]) -> str:
    """Cells of text."""
    return "".join(f'<td class="text">{escape(word)}</td>' for word in words)


def number(value: float | None, column: Column, best: float | None = None, spread: float | None = None) -> str:
    """A cell with a metric, marked where it is the best."""
    mark = ' class="best"' if value is not None and value == best else ""
    return f"<td{mark}>{cell(value, spread, column.factor, column.digits)}</td>"


def best_of(values: Iterable[float | None], column: Column) -> float | None:
    """The best of several numbers; None where there is but one."""
    known = [value for value in values if value is not None]
    return (min if column.is_lower_better else max)(known) if len(known) > 1 else None


def picture(content: str, words: str) -> str:
    """A JPEG in base64; nothing without one."""
    return f'<img alt="{escape(words)}" src="data:image/jpeg;base64,{content}">' if content else ""


def link(page_folder: Path, path: Path, words: str) -> str:
    """A relative link to what is there; nothing where it is not."""
    relative = quote(os.path.relpath(path, page_folder).replace(os.sep, "/"))
    return f'<a href="./{relative}">{escape(words)}</a>' if path.exists() else ""


def run_facts(metrics: Mapping[str, Any]) -> str:
    """Error of the path beside the prior's, and the frames, in one line."""
    ours, raw = (metrics.get(prefix + MAIN[0].key) for prefix in ("", RAW_PRIOR))
    words = ["no ground truth"] if ours is None else [f"path off by {100 * ours:.1f} cm"]
    if ours is not None and raw is not None:
        words[0] += f" (prior alone: {100 * raw:.1f} cm)"
    words += [
        f"{metrics[f'frames/{status}']} {status}"
        for status in ("tracked", "degraded", "lost", "skipped")
        if metrics.get(f"frames/{status}")
    ]
    return ", ".join(words)


def thumbnails(paths: Sequence[Path], widths: Sequence[int] = _WIDTHS) -> list[str]:
    """JPEGs in base64 of pictures, "" where there is none: as large as all of them fit, the smallest if none do."""
    images: list[Image.Image | None] = []
    for path in paths:
        try:
            with Image.open(path) as image:
                small = image.convert("RGB")
        except (OSError, SyntaxError, ValueError):  # not there, or damaged; Pillow has all three
            images.append(None)
            continue
        small.thumbnail((widths[0], 4 * widths[0]))
        images.append(small)
    for width in widths:
        for image in images:
            if image is not None:
                image.thumbnail((width, 4 * width))
        found = ["" if image is None else jpeg(image) for image in images]
        if sum(map(len, found)) <= PICTURE_BYTES:
            return found
    total, kept = 0, []
    for content in found:  # the first that fit
        total += len(content)
        kept.append(content if total <= PICTURE_BYTES else "")
    return kept

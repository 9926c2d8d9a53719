"""Pages: fill the templates in `web/`; every text in them is escaped.

A page is one file that opens by double click, makes no request, and can be read without running its program, too.
"""

import base64
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from emgs_jax.drawing.colors import STATUS_COLORS
from emgs_jax.io.files import write_file
from emgs_jax.runs.finished_run import REPORT_FILE

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
MAX_BYTES = 5_000_000
PICTURE_BYTES = 3_500_000  # of base64, for all pictures of a table together
MAX_LINES = 500  # of a table, for the same reason
_WIDTHS = (360, 240, 160, 100)  # pixels
_QUALITY = 80  # of JPEG
_SOURCE = Path(__file__).parent / "web"
_TEMPLATES = Environment(
    loader=FileSystemLoader(_SOURCE), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
)
_TEMPLATES.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
_OWN = "made by this program, Apache-2.0"
DATA_LICENCES = {
    "synthetic": _OWN,
    "apartment": _OWN,
    "tum": "TUM RGB-D: CC BY 4.0; another folder of this layout: see its publisher",
    "seven_scenes": "7-Scenes: see the data set's page at Microsoft Research",
    "bonn": "Bonn RGB-D Dynamic: see the data set's page at the University of Bonn",
    "euroc": "EuRoC MAV: see the data set's page at ETH Zurich; another folder of this layout: see its publisher",
    "kitti": "KITTI: CC BY-NC-SA 3.0",
    "replica": "Replica: Replica Dataset Research Terms, for research and education that is not commercial",
    **dict.fromkeys(("images", "camera", "colmap", "nerfstudio", "rosbag"), "your own images, your own licence"),
}


class Head(NamedTuple):
    """The top of a page, and its foot."""

    window: str
    title: str
    beside: str  # subtitle, in small letters
    level: str  # of the verdict: good, mixed, bad or unknown
    verdict: str
    is_simulated: bool
    remarks: Sequence[str]  # empty ones are left out
    command: str  # repeats what the page shows; "" if unknown
    sources: Sequence[tuple[str, str]]  # data sets and priors whose licences stand at the foot


def page(template: str, head: Head, policy: str = POLICY, **values: Any) -> bytes:
    """Fill a template of `web/`."""
    shared = {"head": head, "policy": policy, "statuses": STATUS_COLORS, "style": source("page.css")}
    licences = [licence_words(*names) for names in head.sources]
    return _TEMPLATES.get_template(template).render(**shared, licences=licences, **values).encode()


def write_page(folder: Path, content: bytes) -> Path:
    """Write report.html into a folder; return its path."""
    write_file(folder / REPORT_FILE, content)
    return folder / REPORT_FILE


def source(name: str) -> Markup:
    """Read a file of `web/`."""
    return Markup((_SOURCE / name).read_text(encoding="utf-8").strip())


def licence_words(name: str, prior: str) -> str:
    """Name the licences of the program, a data set and a prior."""
    data = DATA_LICENCES.get(name, f"{name}: see its publisher")
    is_own = prior.startswith(("simulated", "multiview_stereo"))
    network = "" if is_own else "; its weights have a licence of their own: docs/networks.md"
    return f"Licences. Page and program: emgs_jax, Apache-2.0. Data: {data}. Prior: {prior}{network}."


def commit_words(git: Mapping[str, Any] | None) -> str:
    """Name the commit of a provenance."""
    return f"commit {git['revision'][:12]}{' with changes' * bool(git.get('dirty'))}" if git else "no checkout"


def jpeg(image: np.ndarray | Image.Image) -> str:
    """Encode RGB, uint8 (h, w, 3), as JPEG in base64."""
    image = image if isinstance(image, Image.Image) else Image.fromarray(image)
    content = io.BytesIO()
    image.convert("RGB").save(content, "JPEG", quality=_QUALITY)
    return base64.b64encode(content.getvalue()).decode("ascii")


def picture(content: str, words: str) -> Markup:
    """Show a JPEG in base64; nothing without one."""
    image = Markup('<img alt="{}" src="data:image/jpeg;base64,{}">')
    return image.format(words, Markup(content)) if content else Markup()


def link(page_folder: Path, path: Path, words: str) -> Markup:
    """Make a relative link to an existing file; nothing if it is missing."""
    relative = quote(os.path.relpath(path, page_folder).replace(os.sep, "/"))
    return Markup('<a href="./{}">{}</a>').format(relative, words) if path.exists() else Markup()


def thumbnails(paths: Sequence[Path], widths: Sequence[int] = _WIDTHS) -> list[str]:
    """Encode pictures as JPEG in base64, as large as all of them fit; "" for one that is missing or does not fit."""
    images: list[Image.Image | None] = []
    for path in paths:
        try:
            with Image.open(path) as image:
                images.append(image.convert("RGB"))
            images[-1].thumbnail((widths[0], 4 * widths[0]))
        except (OSError, SyntaxError, ValueError):  # missing or damaged; Pillow raises all three
            images.append(None)
    for width in widths:
        for image in filter(None, images):
            image.thumbnail((width, 4 * width))
        found = ["" if image is None else jpeg(image) for image in images]
        if sum(map(len, found)) <= PICTURE_BYTES:
            return found
    sizes = np.cumsum([len(content) for content in found])
    return [content if size <= PICTURE_BYTES else "" for content, size in zip(found, sizes, strict=True)]

"""Write the tables of README.md and docs/measurements/results.md: `python -m tools.tables root=FOLDER [KEY=VALUE …]`.

The rows are the evaluations of tools/tables.yaml, whose keys can be given; what is finished is not run again. Nothing
is written unless all are finished and of one commit. The first page has the rows and columns that most people look for;
the second has all, and counts the runs in which the map is better.
"""

import re
import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from emgs_jax.config.configure import compose
from emgs_jax.config.overrides import quoted
from emgs_jax.device.settings import use_compilation_cache
from emgs_jax.io.files import check_writable, write_file
from emgs_jax.report.columns import Column, Line, markdown, metric_table
from emgs_jax.report.tables import COLUMNS as ALL
from emgs_jax.report.tables import average
from emgs_jax.runs.provenance import git_now
from emgs_jax.runs.results import METRICS_FILE, Estimate, estimates_of, read_metrics
from experiments.evaluate import evaluate, plan

CONFIG = Path(__file__).with_suffix(".yaml")
COLUMNS = tuple(column._replace(digits=1) for column in ALL if not column.key.startswith(("time/", "trajectory/scale")))
_SHORT = OmegaConf.load(CONFIG).short.columns
SHORT = tuple(column._replace(title=_SHORT[column.key]) for column in COLUMNS if column.key in _SHORT)


def evaluations(config: Mapping[str, Any], table: str) -> Iterator[Mapping[str, Any]]:
    """The settings of the evaluations of one table; `config` is a resolved tables.yaml."""
    for entry in config["tables"][table]:
        composed = compose(f"suite.root={quoted(config['root'])}", "suite=slices", name="evaluate")
        settings = OmegaConf.to_container(composed, resolve=True)
        data = {name: settings["suite"]["data"][name] for name in entry["data"]}
        own = {"seeds": entry["seeds"], "variants": entry["settings"], "out": str(Path(config["out"]) / table)}
        yield settings | {"suite": {"data": data}} | own


def revision_of(blocks: Iterable[Mapping[str, Any] | None]) -> str:
    """The commit that all of these say they are of; raises ValueError where there is no such one."""
    found = {None if block is None or block["dirty"] is not False else block["revision"] for block in blocks}
    revision = found.pop() if found else None
    if found or revision is None:
        raise ValueError("tables are of one commit without changes: commit, move other results away, and run again")
    return revision[:12]


def _code_of(paths: Iterable[Path]) -> list[Mapping[str, Any] | None]:
    return [read_metrics(path)["provenance"]["git"] for path in paths]


def block(paths: Sequence[Path], titles: Mapping[str, str]) -> str:
    """The Markdown between two markers: where the results come from, the table, and how often ours is better."""
    estimates = [item for path in paths for item in estimates_of(path)]
    return f"\n{_about(paths)}\n\n{_table(estimates, titles, COLUMNS)}\n{_better(estimates)}\n\n"


def short_block(paths: Sequence[Path], titles: Mapping[str, str], short: Mapping[str, Sequence[str]]) -> str:
    """Likewise with the columns of `SHORT`, and of the rows those of the `data`, `settings` and `kinds` of `short`."""
    estimates = [item for path in paths for item in estimates_of(path)]
    places = {"dataset": "data", "variant": "settings", "kind": "kinds"}
    shown = [item for item in estimates if all(getattr(item, name) in short[key] for name, key in places.items())]
    return f"\n{_about(paths)}\n\n{_table(shown, titles, SHORT, is_best_bold=True)}\n"


def _about(paths: Sequence[Path]) -> str:
    """Prior, data, seeds, protocol, device and commit, in words."""

    def distinct(values: Iterable[Any]) -> str:
        return ", ".join(map(str, dict.fromkeys(values)))

    blocks = [read_metrics(path) for path in paths]
    origins = [block["provenance"] for block in blocks]
    frames = {
        f"{origin['data']['name']} {origin['data']['sequence']}": found["trajectory/num_frames"]
        for found, origin in zip(blocks, origins, strict=True)
    }
    label = " (**simulated**)" if any(origin["simulated"] for origin in origins) else ""
    devices = [origin["device"] for origin in origins]
    facts = {
        "Prior": distinct(origin["prior"]["name"] for origin in origins) + label,
        "data": ", ".join(f"{name} ({count} frames)" for name, count in frames.items()),
        "`prior.seed`": distinct(origin["seed"] for origin in origins),
        "protocol": distinct(origin["protocol"] for origin in origins),
        "device": distinct(f"{device['kind']}, {device['cpu_count']} CPU cores" for device in devices),
        "commit": f"`{revision_of(origin['git'] for origin in origins)}`",
    }
    return textwrap.fill("; ".join(f"{name} {value}" for name, value in facts.items()) + ".", 130)


def _table(
    estimates: Sequence[Estimate], titles: Mapping[str, str], columns: Sequence[Column], is_best_bold: bool = False
) -> str:
    """A line for each data set, setting and kind; with `is_best_bold` the best of each data set and setting is bold."""
    lines, rows = [], average(estimates, each_sequence=True)
    for row in sorted(rows, key=lambda row: list(titles).index(row.dataset)):
        name = titles[row.dataset] + ("" if row.variant == "default" else f", {row.variant}")
        rivals = (row.dataset, row.variant) if is_best_bold else None
        lines.append(Line([name, row.kind, str(len(row.seeds))], row.values, row.spreads, rivals))
    return markdown(metric_table(["data, setting", "", "runs"], columns, lines, {row.dataset for row in rows}))


def _better(estimates: Sequence[Estimate]) -> str:
    """For each setting, other estimate and metric, in how many runs ours is better."""
    variants: dict[str, dict[Path, dict[str, Estimate]]] = {}
    for item in estimates:
        variants.setdefault(item.variant, {}).setdefault(item.folder, {})[item.kind] = item
    lines = []
    for variant, runs in variants.items():
        for kind in dict.fromkeys(kind for run in runs.values() for kind in run if kind != "ours"):
            counts = [(column.title.split(" [")[0], _count(runs.values(), kind, column)) for column in COLUMNS]
            shown = ", ".join(f"{title} {count}" for title, count in counts if count is not None)
            lines.append(f"Runs of {len(runs)} in which ours is better than {kind} ({variant}): {shown}.")
    return "\n\n".join(lines)


def _count(runs: Iterable[Mapping[str, Estimate]], kind: str, column: Column) -> int | None:
    """None where one of the two has no such value in any run."""
    pairs = [[run[name].values.get(column.key) for name in ("ours", kind)] for run in runs if kind in run]
    pairs = [pair for pair in pairs if None not in pair]
    sign = 1 if column.is_lower_better else -1
    return sum(sign * (ours - other) < 0 for ours, other in pairs) if pairs else None


def with_blocks(page: Path, blocks: Mapping[str, str]) -> str:
    """A page with other text between `<!-- table: NAME -->` and `<!-- end -->`; ValueError where a pair is missing."""
    if not page.is_file():
        raise ValueError(f"{page} is no file: give page=FILE and full_page=FILE with the places of the tables")
    text = page.read_text(encoding="utf-8")
    for name, content in blocks.items():
        start = f"<!-- table: {name} -->"
        place = re.compile(re.escape(start) + r"\n.*?(?=<!-- end -->)", re.DOTALL)
        text, count = place.subn(lambda _, new=f"{start}\n{content}": new, text)
        if count != 1:
            raise ValueError(f"{page} has {count} places {start} … <!-- end -->, not one: write the markers once")
    return text


def tables(config: Mapping[str, Any]) -> None:
    """Run what is not finished and write all tables of both pages; `config` is a resolved tables.yaml."""
    pages = Path(config["page"]), Path(config["full_page"])
    for page in pages:  # before the runs
        check_writable(page.parent, str(page))
        with_blocks(page, dict.fromkeys(config["tables"], ""))
    planned = {name: list(evaluations(config, name)) for name in config["tables"]}
    paths = {name: [job.folder / METRICS_FILE for one in some for job in plan(one)] for name, some in planned.items()}
    everything = [path for found in paths.values() for path in found]
    finished = [path for path in everything if path.is_file()]
    if len(finished) < len(everything):  # in half an hour it would be too late to learn that the code has changes
        revision_of([git_now(), *_code_of(finished)])
    problems = [line for table in planned.values() for settings in table for line in evaluate(settings)]
    if problems:
        raise ValueError("\n       ".join([f"problems: {len(problems)}", *problems]))
    revision_of(_code_of(everything))
    titles, short = config["titles"], config["short"]
    shown = {name: short_block(found, titles, short) for name, found in paths.items()}
    for page, blocks in zip(pages, (shown, {name: block(found, titles) for name, found in paths.items()}), strict=True):
        write_file(page, with_blocks(page, blocks))


def main() -> None:
    config = OmegaConf.merge(OmegaConf.load(CONFIG), OmegaConf.from_cli(sys.argv[1:]))
    use_compilation_cache()
    tables(OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    print(f"the tables of {config.page} and {config.full_page} are written")


if __name__ == "__main__":
    main()

"""Folders of results: OUT/data set/sequence/variant/seed/metrics.json, and reading them back."""

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from emgs_jax.io.files import changes, jsonable
from emgs_jax.runs.provenance import RESULT_FORMAT, ROWS, prefix_of

METRICS_FILE = "metrics.json"
ANOTHER_NAME = (
    "give these settings another name (+variants.NAME={KEY:VALUE} of emgs evaluate, method=NAME of emgs score), choose "
    "another out=FOLDER or move the folder away"
)
_PLACES = ("dataset.root", "compilation_cache")  # places, not what is computed


@contextmanager
def sound(what: str, remedy: str = "run again") -> Iterator[None]:
    """Turn any error about the contents of a file that the block reads into one ValueError."""
    try:
        yield
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, yaml.YAMLError) as error:
        raise ValueError(f"{what} ({error!r}): {remedy}") from error


@dataclass(frozen=True)
class Estimate:
    """Estimate of one run that was compared with the truth: the map, the raw predictions, or a baseline."""

    folder: Path
    dataset: str
    sequence: str
    variant: str
    kind: str  # "ours", "raw prior", another one of `ROWS`, or "scored" for another system
    seed: int
    prior: str | None  # its name; None for another system
    is_simulated: bool
    protocol: str
    revision: str | None  # of the code; None where unknown
    values: dict[str, float]


def result_folder(out: Path, dataset: str, sequence: str, variant: str, seed: int) -> Path:
    """Return the folder of one result; ValueError if a part is not a single name and would lead elsewhere."""
    parts = {"dataset": dataset, "sequence": str(sequence).replace("/", "_"), "variant or method": variant}
    for what, part in parts.items():
        if not re.fullmatch(r"[^/\\\0]+", part) or part in (".", ".."):
            raise ValueError(f"{what} must be a name that is one folder below out={out}, got {part!r}: choose another")
    return out.joinpath(*parts.values(), str(seed))


def read_metrics(path: Path, remedy: str = "move its folder away or choose another out=FOLDER") -> dict[str, Any]:
    """Read a metrics.json of this version; otherwise raise ValueError with the remedy."""
    with sound(f"{path} is not the result of a run", remedy):
        metrics = json.loads(path.read_text(encoding="utf-8"))
        found = metrics["provenance"].get("format")
    if found != RESULT_FORMAT:
        raise ValueError(f"{path} was written by another version (format {found}, not {RESULT_FORMAT}): {remedy}")
    return metrics


def is_finished(folder: Path, config: Mapping[str, Any], remedy: str = ANOTHER_NAME) -> bool:
    """Test whether the result exists; raise ValueError, with `remedy`, if it was made with another config."""
    path = folder / METRICS_FILE
    if not path.exists():
        return False
    if changed := changes(read_metrics(path)["provenance"]["config"], jsonable(config), _PLACES):
        raise ValueError(
            f"{path} was made with other settings ({'; '.join(changed[:3])}{'; …' * (len(changed) > 3)}): {remedy}"
        )
    return True


def read_estimates(out: Path) -> list[Estimate]:
    """Read all results below `out`, in the order of their folders; skip folders that are no seeds, such as copies."""
    paths = (path for path in sorted(out.glob(f"*/*/*/*/{METRICS_FILE}")) if path.parent.name.isdecimal())
    return [item for path in paths for item in estimates_of(path)]


def estimates_of(path: Path) -> list[Estimate]:
    """Read the estimates of one result: ours, the raw prior and baselines, or another system."""
    metrics = read_metrics(path)
    block, folder, found = metrics["provenance"], path.parent, {"": {}}
    for key, value in metrics.items():
        values = found.setdefault(prefix := prefix_of(key), {})
        if isinstance(value, int | float):
            values[key.removeprefix(prefix)] = value
    kinds = ROWS | {"": "ours" if block["prior"] else "scored"}
    return [
        Estimate(
            folder=folder,
            dataset=block["data"]["name"],
            sequence=block["data"]["sequence"],
            variant=folder.parent.name,
            kind=kind,
            seed=int(folder.name),
            prior=(block["prior"] or {}).get("name"),
            is_simulated=block["simulated"],
            protocol=block["protocol"],
            revision=(block["git"] or {}).get("revision"),
            values=found[prefix],
        )
        for prefix, kind in kinds.items()
        if prefix in found
    ]

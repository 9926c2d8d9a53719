"""The files of a sweep: sweep.json after every chunk, from which it is resumed, and the places of its pictures."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from emgs_jax.io.files import changes, jsonable, write_json
from emgs_jax.report.results import sound

FORMAT, VERSION = "emgs_jax.running.stacked", 1
_REMEDY = "make it again in another folder (hydra.run.dir=…), or move this one away"


def read_sweep(path: Path) -> dict[str, Any]:
    """Read a sweep.json of this version; any other raises ValueError."""
    with sound(f"{path} is damaged", _REMEDY):
        sweep = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(sweep, dict) or (sweep.get("format"), sweep.get("version")) != (FORMAT, VERSION):
        raise ValueError(f"{path} is not a sweep of version {VERSION}: {_REMEDY}")
    return sweep


class SweepResults:
    """Metrics by setting, on disk after each `add`; a folder that holds some of the same sweep is continued.

    Args:
        provenance: what all settings share. Results of other data, predictions, values or code are not mixed with
            these: ValueError.
    """

    def __init__(self, folder: Path, provenance: Mapping[str, Any]) -> None:
        self.path = folder / "sweep.json"
        self._header = jsonable({"format": FORMAT, "version": VERSION, "provenance": provenance})
        old = read_sweep(self.path) if self.path.exists() else self._header | {"settings": []}
        keys = ("data", "prior", "config", "git", "versions")
        before, now = ({key: sweep["provenance"].get(key) for key in keys} for sweep in (old, self._header))
        if changed := changes(before, now):
            raise ValueError(f"{self.path} holds another sweep ({changed[0]}): {_REMEDY}")
        self._rows: dict[str, dict[str, Any]] = {_key(row["setting"]): row for row in old["settings"]}

    def __contains__(self, setting: Mapping[str, Any]) -> bool:
        return _key(setting) in self._rows

    def add(self, settings: Sequence[Mapping[str, Any]], metrics: Sequence[Mapping[str, Any]]) -> None:
        """Keep the metrics of some settings and write all of them."""
        for setting, values in zip(settings, metrics, strict=True):
            self._rows[_key(setting)] = jsonable({"setting": setting, "metrics": values})
        write_json(self.path, self._header | {"settings": list(self._rows.values())})

    def rows(self, settings: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Return one flat row for each setting: its values, then its metrics."""
        found = [self._rows[_key(setting)] for setting in settings]
        return [{"setting": number} | row["setting"] | row["metrics"] for number, row in enumerate(found)]


def _key(setting: Mapping[str, Any]) -> str:
    return json.dumps(jsonable(setting), sort_keys=True)


def picture_path(folder: Path, setting: Mapping[str, Any]) -> Path:
    """Return the path of a setting's picture; its name follows from the values."""
    return folder / "pictures" / f"{hashlib.sha256(_key(setting).encode()).hexdigest()[:16]}.jpg"

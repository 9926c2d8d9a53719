"""Record predictions on disk and replay them bit for bit.

The format `emgs_jax.predictions`, version 3, is a folder without pickles:

- `manifest.json`: the keys of `MANIFEST`, `format`, `version`, and `sha256` of all other keys (as JSON, sorted, without
  spaces); `files` maps file names to the SHA-256 of their contents.
- `000000.npz`, …, one per inference: `inference` (), `views` (v,), `dense` (d,), `current` () and the arrays of
  `PriorPrediction`, optional ones if the prior gives them: about d·(17·h·w + 2·y·x·f) bytes. Points are float32, as a
  float16 step is 2 mm at 2 to 4 m.
- `visits_A_…_B.npz`, one per inference with views of two visits (`recorded_visits`), likewise.
- `text_features.npz`: the array `text_features` (classes, f).

Files are written atomically, data before the manifest: `record` completes what was interrupted.
"""

import hashlib
import io
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from emgs_jax.data.base import Dataset, Frame
from emgs_jax.data.reading import is_rigid
from emgs_jax.io.files import remove_temporaries, write_file
from emgs_jax.io.npz import read_npz
from emgs_jax.prior.base import (
    Prior,
    PriorPrediction,
    Provenance,
    Window,
    calls_of,
    check_pose_std,
    check_unit,
    equal_covariances,
    with_frames,
)

FORMAT, VERSION = "emgs_jax.predictions", 3
WINDOW = ("inference", "views", "dense", "current")
COMPLETE = "`python -m experiments.predict`, called as for the others, makes what is missing or damaged"
REMEDY = "record into another folder with `python -m experiments.predict`"
FIELDS = {  # array -> dtype and axes; d, v, h, w, i, j, c, k, l have one length each, y, x, f are free
    "T_anchor_view": (np.float64, "vij"),
    "points": (np.float32, "dhwc"),
    "confidence": (np.float32, "dhw"),
    "mask": (np.bool_, "dhw"),
    "features": (np.float16, "dyxf"),
}
OPTIONAL = {"pose_covariance": (np.float64, "vkl"), "scale_std": (np.float64, ""), "world": (np.int64, "")}
MAX_LENGTH = 1e6  # of a position, in the prior's unit
MANIFEST = {
    "dataset": {"name": str, "sequence": str, "num_frames": int, "size": list, "intrinsics": list, "fingerprint": str},
    "window_size": int,
    "provenance": {"name": str, "settings": dict, "is_simulated": bool},
    "feature_names": list,
    "num_inferences": int,
    "complete": bool,
    "files": dict,
}


def check_manifest(path: object, manifest: Mapping[str, Any], expected: Mapping[str, Any] = MANIFEST) -> None:
    """Raise ValueError if a key of a manifest is missing, unknown or of another type."""
    for key, kind in expected.items():
        kind, block = (dict, kind) if isinstance(kind, dict) else (kind, None)
        if type(manifest.get(key)) is not kind or (block and manifest[key].keys() - block.keys()):
            what = f" with {', '.join(block)}" if block else ""
            raise ValueError(f"{path} is no manifest: {key} must be there as {kind.__name__}{what}: {REMEDY}")
        if block:
            check_manifest(path, manifest[key], block)


def check_arrays(path: object, arrays: Mapping[str, np.ndarray], sizes: Mapping[str, int]) -> None:
    """Raise ValueError if an array has another dtype or shape than the format."""
    sizes = {**sizes, "i": 4, "j": 4, "c": 3, "k": 6, "l": 6}
    for key, (dtype, axes) in (FIELDS | {key: OPTIONAL[key] for key in OPTIONAL if key in arrays}).items():
        got = arrays[key]
        expected = tuple(sizes.get(axis, got.shape[k] if k < got.ndim else 0) for k, axis in enumerate(axes))
        if got.dtype != dtype or got.shape != expected:
            raise ValueError(
                f"{path}: {key} must be {np.dtype(dtype)} {expected}, got {got.dtype} {got.shape}: {REMEDY}"
            )


def check_numbers(path: object, arrays: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError if numbers under the mask, or finite poses, are senseless; other poses are unknown."""
    points, confident = arrays["points"][arrays["mask"]], arrays["confidence"][arrays["mask"]]
    poses = arrays["T_anchor_view"]
    poses = poses[np.isfinite(poses).all((1, 2))]
    means_something = {
        f"points under the mask are not finite, or farther than {MAX_LENGTH:g}": np.abs(points) <= MAX_LENGTH,
        "a confidence under the mask is negative or not finite": (confident >= 0) & np.isfinite(confident),
        "features are not finite": np.isfinite(arrays["features"]),
        "a pose is no rigid motion": is_rigid(poses),
        f"a pose is farther than {MAX_LENGTH:g}": np.abs(poses[:, :3, 3]) <= MAX_LENGTH,
    }
    for what, is_sound in means_something.items():
        if not np.all(is_sound):
            raise ValueError(f"{path}: {what}: the recording is forged or its prior has a fault; {REMEDY}")


def record(
    prior: Prior,
    dataset: Dataset,
    window_size: int,
    folder: Path | str,
    progress: Callable[[Sequence[Window]], Iterable[Window]] = iter,
) -> None:
    """Write the predictions of every window of a data set, keeping those that exist; `progress` is tqdm or the like.

    Raises:
        ValueError: the prior adjusts poses that it has predicted, which a recording cannot hold.
    """
    if prior.adjusts_poses:
        raise ValueError(
            "prior.structure.online=true adjusts earlier poses, and a recording cannot hold that: record with "
            "prior.structure.online=false, which sees all images at once, or map without a recording (emgs run)"
        )
    folder = Path(folder)
    calls = list(calls_of(prior, dataset, window_size))
    header = {
        "format": FORMAT,
        "version": VERSION,
        "dataset": _described(dataset),
        "window_size": window_size,
        "provenance": asdict(prior.provenance),
        "feature_names": list(prior.feature_names),
        "num_inferences": len(calls),
        "complete": False,
    } | ({} if prior.metre == 1 else {"metre": prior.metre})
    header = json.loads(json.dumps(header))  # as it will be read
    files = _resume(folder, header)
    folder.mkdir(parents=True, exist_ok=True)
    remove_temporaries(folder)
    files["text_features.npz"] = _write_npz(folder / "text_features.npz", {"text_features": prior.text_features})
    names = [f"{window.inference:06d}.npz" for window in calls]
    missing = {row for row, name in enumerate(names) if _digest_of(folder / name) != files.get(name, "")}
    for window, frames in with_frames((call for call in progress(calls) if call.inference in missing), dataset):
        prediction = prior.predict(window, list(frames.values()), dataset.intrinsics)
        check_unit(prediction)
        name = names[window.inference]
        files[name] = _write_npz(folder / name, _arrays(prediction))
        _write_manifest(folder, header, files)
    _write_manifest(folder, header | {"complete": True}, files)


def visits_file(window: Window) -> str:
    return f"visits_{'_'.join(f'{view:06d}' for view in window.views)}.npz"


def add_visits(folder: Path, prediction: PriorPrediction) -> None:
    """Add a prediction of two visits to a complete recording."""
    manifest, name = _read_manifest(folder), visits_file(prediction.window)
    files = manifest.pop("files")
    files[name] = _write_npz(folder / name, _arrays(prediction))
    _write_manifest(folder, manifest, files)


class Recorded(Prior):
    """A prior that replays a complete recording; `pose_std`, (length, degrees), replaces the recorded covariances."""

    def __init__(self, folder: Path | str, pose_std: Sequence[float] | None = None) -> None:
        self.folder, self._pose_std = Path(folder), check_pose_std(pose_std)
        self._manifest = _read_manifest(self.folder)
        if not self._manifest["complete"]:
            total = self._manifest["num_inferences"]
            done = sum(self.has_whole(f"{number:06d}.npz") for number in range(total))
            raise ValueError(f"{self.folder} holds {done} of {total} inferences: {COMPLETE}")
        self.provenance = Provenance(**self._manifest["provenance"])
        if self._pose_std is not None:
            settings = self.provenance.settings | {"pose_std": [*self._pose_std]}
            self.provenance = replace(self.provenance, settings=settings)
        self.feature_names = tuple(self._manifest["feature_names"])
        self.text_features = self._load("text_features.npz", ("text_features",))["text_features"]
        text = self.text_features
        fits = text.ndim == 2 and len(text) == len(self.feature_names) and text.dtype.kind == "f"
        if not fits or not np.isfinite(text).all():
            raise ValueError(
                f"{self.folder / 'text_features.npz'} must hold a finite vector for each of {len(self.feature_names)} "
                f"names, got {text.shape}: {REMEDY}"
            )

    def num_newer(self, window_size: int) -> int:
        """The number that was recorded: the first window's newer views come after the dense ones."""
        first = self._load("000000.npz", ("views", "dense"))
        return 1 + len(first["views"]) - len(first["dense"])

    @property
    def metre(self) -> float:
        """That of the prior that was recorded."""
        metre = self._manifest.get("metre", 1.0)
        if type(metre) is not float or not 0 < metre < math.inf:
            raise ValueError(f"{self.folder / 'manifest.json'}: metre must be a positive number, got {metre}: {REMEDY}")
        return metre

    def check(self, dataset: Dataset, window_size: int) -> None:
        """Raise ValueError unless the recording is of this data set, calibration and window size."""
        expected = _described(dataset) | {"window_size": window_size}
        recorded = self._manifest["dataset"] | {"window_size": self._manifest["window_size"]}
        for key, value in expected.items():
            if recorded.get(key) != value:
                raise ValueError(
                    f"{self.folder} was recorded with {key} {recorded.get(key)}, but this run has {value}: "
                    f"choose the recording of this sequence or {REMEDY}"
                )

    def predict(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        """The recorded prediction of `window`; only number and size of `frames` are checked."""
        return self._answer(f"{window.inference:06d}.npz", window, frames, intrinsics)

    def revisit(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction | None:
        """The recorded prediction of two visits, or None."""
        name = visits_file(window)
        return self._answer(name, window, frames, intrinsics) if name in self._manifest["files"] else None

    def has_whole(self, name: str) -> bool:
        """Test by its checksum whether a file is as it was written."""
        return _digest_of(self.folder / name) == self._manifest["files"].get(name, "")

    def _answer(
        self, name: str, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]
    ) -> PriorPrediction:
        data = self._manifest["dataset"]
        shape, size = frames[0].image.shape[:2], tuple(data["size"])
        if [*intrinsics] != data["intrinsics"] or shape != size[::-1] or len(frames) != len(window.views):
            raise ValueError(
                f"{self.folder} was recorded at size {size} with intrinsics {data['intrinsics']}; asked for are "
                f"{len(frames)} frames of {shape[::-1]} with {[*intrinsics]} as {len(window.views)} views: {REMEDY}"
            )
        arrays = self._load(name, (*WINDOW, *FIELDS), (*OPTIONAL,))
        if not all(np.array_equal(arrays[key], getattr(window, key)) for key in WINDOW):
            raise ValueError(
                f"{self.folder / name} answers another window ({arrays['views'].tolist()}) than {window}: {REMEDY}"
            )
        sizes = {"v": len(window.views), "d": len(window.dense), "h": shape[0], "w": shape[1]}
        check_arrays(self.folder / name, arrays, sizes)
        check_numbers(self.folder / name, arrays)
        given = equal_covariances(self._pose_std, arrays["T_anchor_view"])
        covariance = arrays.get("pose_covariance") if given is None else given
        scale_std, world = (arrays[key].item() if key in arrays else None for key in ("scale_std", "world"))
        return PriorPrediction(window, *(arrays[key] for key in FIELDS), covariance, scale_std, world)

    def _load(self, name: str, keys: Sequence[str], optional: Sequence[str] = ()) -> dict[str, np.ndarray]:
        path = self.folder / name
        if not path.is_file():
            raise ValueError(f"{path} is missing: {COMPLETE}")
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != self._manifest["files"].get(name):
            raise ValueError(f"{path} is damaged (its SHA-256 is not the manifest's): {COMPLETE}")
        try:
            return read_npz(content, keys, optional)
        except ValueError as error:
            raise ValueError(f"{path} is no file of this format ({error}): {REMEDY}") from error


def _described(dataset: Dataset) -> dict:
    """What identifies the frames, as JSON gives it back."""
    return {
        "name": dataset.name,
        "sequence": dataset.sequence,
        "num_frames": len(dataset),
        "size": [int(value) for value in dataset.size],
        "intrinsics": [float(value) for value in dataset.intrinsics],
        "fingerprint": dataset.fingerprint(),
    }


def _resume(folder: Path, header: dict) -> dict[str, str]:
    """The files (name -> SHA-256) of an earlier `record` with the same header."""
    if not (folder / "manifest.json").exists():
        return {}
    old = _read_manifest(folder)
    for key in header.keys() - {"complete"}:
        if old.get(key) != header[key]:
            raise ValueError(
                f"{folder} holds a recording with {key} {old.get(key)}, not {header[key]}: choose another folder"
            )
    return old["files"]


def _read_manifest(folder: Path) -> dict:
    path = folder / "manifest.json"
    if not path.is_file():
        raise ValueError(f"{path} is missing: expected the folder of a recording (manifest.json, 000000.npz, …)")
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged ({error}): {REMEDY}") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ValueError(f"{path} is not of the format {FORMAT}: {REMEDY}")
    if manifest.get("version") != VERSION:
        raise ValueError(f"{path} has version {manifest.get('version')}, this program reads {VERSION}: {REMEDY}")
    if manifest.pop("sha256", None) != _digest(manifest):
        raise ValueError(f"{path} is damaged (its SHA-256 does not fit): {REMEDY}")
    check_manifest(path, manifest)
    return manifest


def _digest(manifest: dict) -> str:
    return hashlib.sha256(json.dumps(manifest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _digest_of(path: Path) -> str | None:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None


def _write_manifest(folder: Path, header: dict, files: dict[str, str]) -> None:
    manifest = header | {"files": files}
    write_file(folder / "manifest.json", json.dumps(manifest | {"sha256": _digest(manifest)}, indent=1))


def _write_npz(path: Path, arrays: dict[str, np.ndarray]) -> str:
    """Write an .npz atomically; return its SHA-256."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    write_file(path, buffer.getvalue())
    return hashlib.sha256(buffer.getvalue()).hexdigest()


def _arrays(prediction: PriorPrediction) -> dict[str, np.ndarray]:
    """The arrays of one inference's file; ValueError if one has another dtype than the format."""
    arrays = {key: np.asarray(getattr(prediction.window, key)) for key in WINDOW}
    given = {key: OPTIONAL[key] for key in OPTIONAL if getattr(prediction, key) is not None}
    for key, (dtype, _) in (FIELDS | given).items():
        arrays[key] = np.asarray(getattr(prediction, key))
        if arrays[key].dtype != dtype:
            # After a conversion the replay would differ from the live run.
            raise ValueError(f"the prior's {key} must be {np.dtype(dtype)}, got {arrays[key].dtype}")
    return arrays

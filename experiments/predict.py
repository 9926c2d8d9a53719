"""Record a prior's predictions of a sequence: `python -m experiments.predict dataset=… prior=… features=… out=DIR`.

`prior=recorded prior.folder=DIR` replays it in `experiments.run`. The same command completes an interrupted recording.
With `graph=default` it also has windows of both visits of a place, for the back end. Without, this script needs no JAX,
unless the prior does, and mapping a recording needs no PyTorch: each may have its own environment.
"""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from omegaconf import DictConfig
from tqdm import tqdm

from emgs_jax.config.configure import build_dataset, build_prior, graph_config
from emgs_jax.data.base import Dataset
from emgs_jax.io.files import owned
from emgs_jax.prior.base import Prior
from emgs_jax.prior.recorded import Recorded, record
from emgs_jax.prior.recorded_visits import places_seen_twice, record_visits

from .command import command


def predict(config: DictConfig) -> Path:
    """Record the predictions of `config` into `config.out`, and print what was recorded."""
    dataset = build_dataset(config)
    prior = build_prior(config, dataset)
    folder = Path(config.out)
    with owned(folder):
        _check_folder(folder)
        record(prior, dataset, config.slam.window_size, folder, _bar("inference", prior.provenance.name))
        if config.graph:
            _record_visits(prior, dataset, config, folder)
    size, frames = sum(path.stat().st_size for path in folder.iterdir()) / 2**20, len(dataset)
    what = f"{dataset.name} {dataset.sequence}, {frames} frames"
    print(f"{folder}: {size:.1f} MiB, {size / frames:.2f} a frame, {what}")
    print(f"prior {prior.provenance.name} {prior.provenance.settings}")
    for key, value in prior.report().items():
        print(f"{key} {value:.4g}")
    return folder


def _check_folder(folder: Path) -> None:
    """Raise ValueError if a folder holds something other than a recording, such as a run."""
    others = [path.name for path in sorted(folder.iterdir()) if not path.name.startswith(".") and path.suffix != ".npz"]
    if others and "manifest.json" not in others:
        raise ValueError(f"out={folder} holds {', '.join(others[:3])} and no recording: give a folder of its own")


def _record_visits(prior: Prior, dataset: Dataset, config: DictConfig, folder: Path) -> None:
    """Record predictions of both visits of a place, for the back end."""
    end, size = graph_config(config), config.slam.window_size
    if not end.prior_query.is_used:
        return
    how = end.place_recognition, end.verification.alignment, _bar("frame", "places seen twice")
    pairs = places_seen_twice(Recorded(folder), dataset, size, *how)
    count = record_visits(prior, dataset, size, folder, pairs, end.prior_query.spacing, _bar("pair", "visits"))
    print(f"{count} windows with both visits of a place, for loops")


def _bar(unit: str, words: str) -> Callable[[Iterable], Iterable]:
    return partial(tqdm, unit=unit, desc=words)


main = command("predict")(predict)

if __name__ == "__main__":
    main()

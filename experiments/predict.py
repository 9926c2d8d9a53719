"""Record what a prior says of a sequence: `python -m experiments.predict dataset=… prior=… features=… out=DIR`.

`prior=recorded prior.folder=DIR` replays it in `experiments.run`. An interrupted recording is completed by the same
command. This script needs no JAX, unless the prior does, and mapping a recording needs no PyTorch: each may have its
own environment.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

from omegaconf import DictConfig
from tqdm import tqdm

from emgs_jax.prior.base import Window
from emgs_jax.prior.recorded import record
from emgs_jax.running.configure import build_dataset, build_prior

from .command import command


def predict(config: DictConfig) -> Path:
    """Record the predictions of `config` into `config.out`."""
    dataset = build_dataset(config)
    prior = build_prior(config, dataset)

    def progress(windows: Sequence[Window]) -> Iterable[Window]:
        return tqdm(windows, unit="inference", desc=prior.provenance.name)

    folder = Path(config.out)
    record(prior, dataset, config.slam.window_size, folder, progress)
    size = sum(path.stat().st_size for path in folder.iterdir()) / 2**20
    per_frame = f"{size / len(dataset):.2f} a frame"
    print(f"{folder}: {size:.1f} MiB, {per_frame}, {dataset.name} {dataset.sequence}, {len(dataset)} frames")
    print(f"prior {prior.provenance.name} {prior.provenance.settings}")
    for key, value in prior.report().items():
        print(f"{key} {value:.4g}")
    return folder


@command("predict")
def main(config: DictConfig) -> None:
    """Record, and say what was recorded."""
    predict(config)


if __name__ == "__main__":
    main()

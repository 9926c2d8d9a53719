"""Export a finished run: `python -m experiments.export FOLDER formats=[colmap,nerfstudio,frustums]`."""

from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from emgs_jax.config.configure import build_dataset
from emgs_jax.config.values import check_keys
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.io.files import check_writable, new_folder, owned
from emgs_jax.ops.camera import Camera
from emgs_jax.runs.export import (
    IMAGE_FORMATS,
    MOVED_FILE,
    ExportConfig,
    export,
    find_factor,
    measured_up,
    to_export,
    write_moved,
)
from emgs_jax.runs.finished_run import FinishedRun, read_run
from emgs_jax.runs.images import images_of

from .command import command, first_words


def export_run(config: DictConfig) -> list[Path]:
    """Write the formats of a config; return the files and folders."""
    check_keys(config, ExportConfig)
    formats, length = list(dict.fromkeys(map(str, config.formats))), config.length and [float(n) for n in config.length]
    choices = str(config.images), str(config.moving), str(config.up)
    wanted = ExportConfig(formats, config.max_points, config.scale, length, *choices)
    run = read_run(Path(str(config.folder)))
    folder = run.folder if config.out is None else Path(str(config.out))
    check_writable(folder, f"{'folder' if config.out is None else 'out'}={folder}")
    factor = find_factor(run, wanted)
    T_export_map = to_export(run, factor, wanted.up)
    if T_export_map is None and not formats:
        raise ValueError(
            "formats=[] without scale=, length= or up=z writes nothing: give colmap, nerfstudio or frustums"
        )
    dataset = None
    if IMAGE_FORMATS & {*wanted.formats}:
        dataset, note = images_of(run)
        if dataset is None:
            raise ValueError(f"{note} formats=[frustums] needs no images")
        if wanted.images == "original":
            run, dataset = at_original_size(run)
    if T_export_map is None:
        with owned(folder):
            return export(run, folder, wanted, dataset)
    target = folder / ("upright" if factor is None else "scaled") if config.out is None else folder
    with owned(target.parent), new_folder(target) as new:
        export(write_moved(run, new, T_export_map), new, wanted, dataset)
    if factor is not None:
        print(f"all lengths times {factor:.6g}")
    if wanted.up == "z":
        by = "what told the scale" if measured_up(run) is not None else "level cameras, floors and walls"
        print(f"z is up, by {by}; {MOVED_FILE} says how the run was turned")
    return sorted(target.iterdir())


def at_original_size(run: FinishedRun) -> tuple[FinishedRun, ReadableFrames]:
    """A run with undistorted images at their size on disk, and their camera; ValueError if the size is unknown."""
    size = run.provenance["data"].get("camera", {}).get("size")
    settings = OmegaConf.create(dict(run.provenance["config"]))
    if size is None or "size" not in settings.dataset:
        raise ValueError(f"{run.folder} does not say how large its images on disk are: give images=used")
    settings.dataset.size = [int(side) for side in size]
    dataset = build_dataset(settings)
    fx, fy, cx, cy = dataset.intrinsics
    return replace(run, camera=Camera((fx, fy), (cx, cy), *dataset.size)), dataset


@command("export", first_words("folder"))
def main(config: DictConfig) -> None:
    for path in export_run(config):
        print(path)


if __name__ == "__main__":
    main()

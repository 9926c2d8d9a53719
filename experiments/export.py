"""A finished run for other programs: `python -m experiments.export FOLDER formats=[colmap,nerfstudio,frustums]`."""

from pathlib import Path

from omegaconf import DictConfig

from emgs_jax.io.files import new_folder
from emgs_jax.report.export import IMAGE_FORMATS, ExportConfig, export, find_factor, write_scaled
from emgs_jax.report.recorded_run import read_run
from emgs_jax.running.values import check_value, declared

from .command import command
from .report import images_of, positional


def export_run(config: DictConfig) -> list[Path]:
    """Write what the config names; returns the files and folders."""
    for key, field in declared(ExportConfig).items():
        check_value(key, config[key], field)
    formats, length = [str(name) for name in config.formats], config.length and [float(n) for n in config.length]
    wanted = ExportConfig(formats, config.max_points, config.scale, length)
    run = read_run(Path(str(config.folder)))
    factor = find_factor(run, wanted)
    dataset = None
    if IMAGE_FORMATS & {*wanted.formats}:
        dataset, note = images_of(run)
        if dataset is None:
            raise ValueError(f"{note} formats=[frustums] needs no images")
    if factor is None:
        folder = run.folder if config.out is None else Path(str(config.out))
        folder.mkdir(parents=True, exist_ok=True)
        return export(run, folder, wanted, dataset)
    target = run.folder / "scaled" if config.out is None else Path(str(config.out))
    with new_folder(target) as folder:
        export(write_scaled(run, folder, factor), folder, wanted, dataset)
    print(f"all lengths times {factor:.6g}")
    return sorted(target.iterdir())


@command("export", positional)
def main(config: DictConfig) -> None:
    """Write, and say where."""
    for path in export_run(config):
        print(path)


if __name__ == "__main__":
    main()

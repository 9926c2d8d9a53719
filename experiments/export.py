"""A finished run for other programs: `python -m experiments.export FOLDER formats=[colmap,nerfstudio,frustums]`."""

from pathlib import Path

from omegaconf import DictConfig

from emgs_jax.report.export import IMAGE_FORMATS, ExportConfig, export
from emgs_jax.report.recorded_run import read_run
from emgs_jax.running.values import check_value, declared

from .command import command
from .report import images_of, positional


def export_run(config: DictConfig) -> list[Path]:
    """Write what the config names; returns the files and folders."""
    for key, field in declared(ExportConfig).items():
        check_value(key, config[key], field)
    wanted = ExportConfig([str(name) for name in config.formats], config.max_points)
    run = read_run(Path(str(config.folder)))
    dataset = None
    if IMAGE_FORMATS & {*wanted.formats}:
        dataset, note = images_of(run.provenance["config"], len(run.poses))
        if dataset is None:
            raise ValueError(f"{note} formats=[frustums] needs no images")
    folder = run.folder if config.out is None else Path(str(config.out))
    folder.mkdir(parents=True, exist_ok=True)
    return export(run, folder, wanted, dataset)


@command("export", positional)
def main(config: DictConfig) -> None:
    """Write, and say where."""
    for path in export_run(config):
        print(path)


if __name__ == "__main__":
    main()

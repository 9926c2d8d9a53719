"""Show a finished run in the browser until Ctrl-C: `python -m experiments.view FOLDER`."""

from pathlib import Path

from omegaconf import DictConfig

from emgs_jax.runs.finished_run import read_run
from emgs_jax.viewer.scene import shown
from emgs_jax.viewer.viewer import Viewer

from .command import command, first_words


def view(config: DictConfig) -> Viewer:
    return Viewer(shown(read_run(Path(str(config.folder)))), config.port)


@command("view", first_words("folder"))
def main(config: DictConfig) -> None:
    viewer = view(config)
    print(f"{viewer.address} shows {config.folder} to this machine; Ctrl-C ends it", flush=True)
    try:
        viewer.server.sleep_forever()
    finally:
        viewer.stop()


if __name__ == "__main__":
    main()

"""Map what a robot sees: `emgs ros image:=/camera/image_raw camera_info:=/camera/camera_info … key=value`.

It is `emgs run` over topics of ROS 2, with the map published while it grows.
"""

from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tqdm import tqdm

from emgs_jax.runs.finished_run import FRAMES_FILE
from emgs_jax.viewer.ros import NewMapError

from .command import command
from .run import run_and_print


def with_topics(arguments: list[str]) -> list[str]:
    """Replace remappings and parameters (NAME:=VALUE) among the arguments by the keys that they imply; keys win."""
    topics = [word.replace("'", "") for word in arguments if ":=" in word]  # `readable` has quoted the names
    given = [word for word in arguments if ":=" not in word]
    found = [f"dataset.source='{' '.join(['ros', *topics])}'"]
    names = {word.partition(":=")[0] for word in topics}
    if "depth" in names and names & {"odometry", "odom_frame"}:
        found.append("prior=stream")
    return [*found, *given]


@command("ros", rewritten=with_topics)
def main(config: DictConfig) -> float:
    """Run, and print the results; the service `reset` begins anew."""
    while True:
        try:
            return run_and_print(config)
        except NewMapError:
            tqdm.write("a new map begins")
            Path(HydraConfig.get().runtime.output_dir, FRAMES_FILE).unlink()  # saved with the map


if __name__ == "__main__":
    main()

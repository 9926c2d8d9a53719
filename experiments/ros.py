"""Map what a robot sees: `emgs ros image:=/camera/image_raw camera_info:=/camera/camera_info … key=value`.

It is `emgs run` over topics of ROS 2, with the map published while it grows.
"""

from omegaconf import DictConfig

from .command import command
from .run import run_and_print


def with_topics(arguments: list[str]) -> list[str]:
    """Replace the remappings (NAME:=TOPIC) among the arguments by the keys that they imply; given keys win."""
    topics = [word.replace("'", "") for word in arguments if ":=" in word]  # `readable` has quoted the names
    given = [word for word in arguments if ":=" not in word]
    found = [f"dataset.source='{' '.join(['ros', *topics])}'"]
    if {"depth", "odometry"} <= {word.partition(":=")[0] for word in topics}:
        found.append("prior=stream")
    return [*found, *given]


@command("ros", rewritten=with_topics)
def main(config: DictConfig) -> float:
    """Run, and print the results."""
    return run_and_print(config)


if __name__ == "__main__":
    main()

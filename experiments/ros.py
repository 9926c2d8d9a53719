"""Map what a robot sees: `emgs ros image:=/camera/image_raw camera_info:=/camera/camera_info … key=value`.

It is `emgs run` over ROS 2 topics, with the map published while it grows.
"""

import sys

from .command import words_of
from .run import main as run


def with_topics(arguments: list[str]) -> list[str]:
    """The arguments of `emgs run` for the remappings (NAME:=TOPIC) and overrides of `emgs ros`; given keys win."""
    topics = [word for word in arguments if ":=" in word]
    given = [word for word in arguments if ":=" not in word]
    names = {word.partition(":=")[0] for word in topics}
    found = {"dataset": "camera", "dataset.source": "'" + " ".join(["ros", *topics]) + "'", "view": "ros"}
    if {"depth", "odometry"} <= names:
        found["prior"] = "stream"
    keys = {word.partition("=")[0].lstrip("+") for word in words_of(given).overrides}
    return [*(f"{key}={value}" for key, value in found.items() if key not in keys), *given]


def main() -> None:
    sys.argv[1:] = with_topics(sys.argv[1:])
    run()


if __name__ == "__main__":
    main()

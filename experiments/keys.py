"""Types and ranges of the commands' own keys, which are no parameters of a class."""

from collections.abc import Sequence
from dataclasses import dataclass

from emgs_jax.ops.ranges import number, one_of


@dataclass(frozen=True)
class EvaluateKeys:
    overrides: Sequence[str]
    shard: str
    seeds: tuple[int, ...] = number(low=0)


@dataclass(frozen=True)
class EmbedKeys:
    classes: Sequence[str]
    out: str


@dataclass(frozen=True)
class SegmentKeys:
    map: str | Sequence[str]
    ignored: Sequence[str]
    with_scale: bool
    num_neighbours: int = number(low=1, high=1000)
    alignment: str = one_of("trajectory", "points")
    icp_distance_m: float = number(low=1e-6)
    icp_max_steps: int = number(low=0, high=10000)
    voxel_m: float = number(low=1e-6)
    max_depth_m: float = number(low=1e-6, high=float("inf"))


@dataclass(frozen=True)
class QueryKeys:
    margin: float = number(low=0, high=2)
    min_cosine: float = number(low=-1, high=1)
    num_views: int = number(low=1, high=100)
    max_words: int = number(low=1, high=1000)
    frame: int | None = number(low=0)


@dataclass(frozen=True)
class ScoreKeys:
    max_time_difference: float = number(low=0)
    min_associated_percent: float = number(low=0, high=100)
    min_matched_percent: float = number(low=0, high=100)
    normal_neighbours: int = number(low=3, high=1000)


@dataclass(frozen=True)
class ViewKeys:
    folder: str
    port: int = number(low=1, high=65535)


KEYS = {
    "embed": EmbedKeys,
    "evaluate": EvaluateKeys,
    "query": QueryKeys,
    "score": ScoreKeys,
    "segment": SegmentKeys,
    "view": ViewKeys,
}

"""Parts of merging without a map: whose features they are, and whose node a record is of."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from emgs_jax.back_end.state import Node
from emgs_jax.features.text import TextEmbeddings
from emgs_jax.mapping.records import FrameRecord
from emgs_jax.runs.merging import check_features, with_records

AXES = np.eye(4, dtype=np.float32)


def run(names, rows=(0, 1, 2), model="clip", width=4):
    text = TextEmbeddings(tuple(names), AXES[list(rows), :width], (), {"name": model})
    return SimpleNamespace(folder="out/a", text=text)


FIRST = run(("wall", "chair", "bed"))


@pytest.mark.parametrize(
    ("other", "is_one"),
    [
        (run(("wall", "chair", "bed")), True),
        (run(("bed", "wall"), rows=(2, 0)), True),  # other words of one model
        (run(("lamp", "wall"), rows=(3, 0)), True),
        (SimpleNamespace(folder="out/b", text=None), True),
        (run(("sky", "road", "car")), False),  # the same vectors for other classes: only their numbers are the same
        (run(("chair", "wall", "bed")), False),
        (run(("wall", "chair", "bed"), model="dino"), False),
        (run(("wall", "chair", "bed"), width=3), False),
    ],
)
def test_features_are_joined_where_they_mean_the_same(other, is_one):
    if is_one:
        check_features(FIRST, other)
        return
    with pytest.raises(
        ValueError, match="are not those of out/a .wall, chair, bed, ….: map both with the same features="
    ):
        check_features(FIRST, other)


@dataclass(frozen=True)
class End:
    """Of a back end what is looked at."""

    nodes: tuple[Node, ...]
    first_node: int = 0


@pytest.mark.parametrize("first", [0, 3])
def test_a_record_belongs_to_its_node_though_frames_are_lost_before_and_in_the_middle(first):
    """Symptom: the path as first estimated lacks lost frames, and nodes were counted by its lines."""
    statuses = ("lost", "lost", "initialization", "tracked", "lost", "tracked")
    records = [
        FrameRecord(index=row, name=None, timestamp=0.0, status=status, pose=np.eye(4), origin=10 + row)
        for row, status in enumerate(statuses)
    ]
    own = len(statuses) - 2  # the map begins with the third
    nodes = tuple(Node(np.eye(4) * row, np.eye(4) * row, 0.0, row) for row in range(first + own))
    online = np.stack([np.full((4, 4), np.nan if status == "lost" else row) for row, status in enumerate(statuses)])
    end, lost = with_records(End(nodes), records, online, first)
    assert end.first_node == first and [node.frame for node in lost] == [0, 1]
    assert [node.origin for node in end.nodes[first:]] == [12, 13, 14, 15]
    assert [node.online[0, 0] for node in end.nodes[first:]] == [2, 3, first + 2, 5]  # the lost one keeps its pose
    assert end.nodes[:first] == nodes[:first]

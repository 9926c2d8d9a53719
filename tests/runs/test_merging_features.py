"""Features of two runs that are merged: of one model and the same classes, or refused."""

from types import SimpleNamespace

import numpy as np
import pytest

from emgs_jax.features.text import TextEmbeddings
from emgs_jax.runs.merging import check_features

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

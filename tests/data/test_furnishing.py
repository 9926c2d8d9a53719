"""Furniture stands apart from each other, from doorways and from who walks by."""

from itertools import combinations

import numpy as np
import trimesh

from emgs_jax.data.furnishing import GAP, LANE, bounds, furnish
from emgs_jax.data.plan import Area


def test_a_piece_finds_a_place_beside_all_that_stand_there_and_none_where_it_would_touch_one():
    chest = ("chest", trimesh.creation.box(bounds=[[0, 0.05, 0], [1, 0.55, 1]]))
    area = Area(low=(0.0, 0.0), high=(4.0, 4.0), doors=())
    placed = furnish(area, [lambda rng: [chest]] * 30, [], np.array([[2.0, 2.0]]), np.random.default_rng(0))
    assert 6 < len(placed) < 16  # walls of 16 metres
    boxes = [bounds([part]) for part in placed]
    for one, other in combinations(boxes, 2):
        assert ((one[0] - other[1] > GAP - 1e-9) | (other[0] - one[1] > GAP - 1e-9)).any()
    for box in boxes:
        assert np.linalg.norm(np.maximum(np.maximum(box[0, :2] - 2.0, 2.0 - box[1, :2]), 0)) > LANE

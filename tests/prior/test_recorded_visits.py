"""Which windows of two visits a recording holds: those of frames that show one place twice, found without a pose."""

import numpy as np
import pytest
from listed_frames import Listed
from loop_scene import loops_config

from emgs_jax.data.synthetic import Synthetic
from emgs_jax.prior.recorded import Recorded, record
from emgs_jax.prior.recorded_visits import places_seen_twice, record_visits
from emgs_jax.prior.simulated.prior import Simulated

WINDOW_SIZE = 3
ROWS = (0, 2, 4, 6, 8, 20, 30, 9, 7, 5, 3, 1)  # of a walk of 40: there, elsewhere, and back


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Data set, folder of its recording, and what looks alike in it."""
    whole, folder = Synthetic(num_frames=40, size=(160, 120)), tmp_path_factory.mktemp("recording")
    dataset = Listed(whole, [whole[row] for row in ROWS])
    record(Simulated(), dataset, WINDOW_SIZE, folder)
    config = loops_config(
        "place_recognition.min_gap=5", "place_recognition.suppressed_gap=1", "place_recognition.num_neighbours=2"
    )
    pairs = places_seen_twice(
        Recorded(folder), dataset, WINDOW_SIZE, config["place_recognition"], config["verification"].alignment
    )
    return dataset, folder, pairs


def test_frames_of_one_place_are_pairs_and_others_are_none(recorded):
    dataset, _, pairs = recorded
    assert len(pairs) >= 3 and len(set(pairs)) == len(pairs)
    for a, b in pairs:
        assert b - a >= 5
        apart = np.linalg.norm(dataset[a].T_world_camera[:3, 3] - dataset[b].T_world_camera[:3, 3])
        assert apart < 1.0, (a, b)
    assert {b for _, b in pairs} <= {7, 8, 9, 10, 11}, "the two frames elsewhere are like none"


def test_a_second_pass_finds_the_same_and_asks_for_nothing_twice(recorded):
    dataset, folder, pairs = recorded
    assert record_visits(Simulated(), dataset, WINDOW_SIZE, folder, pairs, 1) == len(pairs)
    names = sorted(path.name for path in folder.glob("visits_*"))
    assert len(names) == len(pairs)

    class Silent(Simulated):
        def predict(self, window, frames, intrinsics):
            raise AssertionError(window)

    assert record_visits(Silent(), dataset, WINDOW_SIZE, folder, pairs, 1) == len(pairs)

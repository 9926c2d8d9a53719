"""Loops against true poses, and double walls: which are right, which returns they find, what stands twice."""

import numpy as np
import pytest
from hand_run import poses_along

from emgs_jax.evaluation.loops import double_wall_share, loop_metrics

THERE_AND_BACK = [*poses_along([*range(40), *range(40, -1, -1)])]


def between(a: int, b: int, truth: list[np.ndarray], error: float = 0.0, turn_deg: float = 0.0) -> tuple:
    cos, sin = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    wrong = np.array([[cos, -sin, 0, error], [sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return a, b, np.linalg.inv(truth[a]) @ truth[b] @ wrong


def test_a_loop_is_right_up_to_30_cm_and_10_degrees_and_a_frame_that_looks_elsewhere_does_not_return():
    loops = [between(0, 80, THERE_AND_BACK, *errors) for errors in ((0.29, 0.0), (0.31, 0.0), (0.0, 9.0), (0.0, 11.0))]
    assert loop_metrics(loops, THERE_AND_BACK, 60)["loops/precision"] == 0.5
    turned = [pose.copy() for pose in THERE_AND_BACK]
    for pose in turned[40:]:
        pose[:3, :3] = np.diag([-1, -1, 1])
    assert loop_metrics([], turned, 60)["loops/returning_frames"] == 0


def test_a_return_is_found_within_ten_frames_of_a_right_loop():
    """Frames 70 to 80 see a place of 60 frames ago within 1 m: 2 |x - x'| apart in time."""
    right, wrong = between(5, 75, THERE_AND_BACK), between(5, 75, THERE_AND_BACK, 1.0)
    found = loop_metrics([right], THERE_AND_BACK, 60)
    assert found["loops/returning_frames"] == 11 and found["loops/recall"] == 1.0
    twice = [*THERE_AND_BACK, *THERE_AND_BACK[1:11]]
    found = loop_metrics([between(10, 90, twice)], twice, 60)  # frames 80 to 90 of those from 70 to 90
    assert found["loops/recall"] == 11 / 21
    assert loop_metrics([wrong], THERE_AND_BACK, 60)["loops/recall"] == 0.0


def test_without_loops_or_returns_or_truth_nothing_is_said():
    assert loop_metrics([], THERE_AND_BACK, 60) == {
        "loops/precision": None,
        "loops/recall": 0.0,
        "loops/returning_frames": 11,
    }
    assert loop_metrics([], THERE_AND_BACK, 90)["loops/recall"] is None
    unknown = [None] * len(THERE_AND_BACK)
    assert loop_metrics([between(5, 75, THERE_AND_BACK)], unknown, 60)["loops/precision"] is None


def test_what_only_loops_into_a_saved_map_may_have_found_is_not_judged():
    """Its frames have no truth here."""
    truth = [None, *THERE_AND_BACK, *THERE_AND_BACK[1:11]]  # frames 71 to 91 return
    into_saved = (0, 81, np.eye(4))
    found = loop_metrics([into_saved], truth, 60)
    assert found["loops/recall"] is None and found["loops/precision"] is None and found["loops/returning_frames"] == 21
    into_saved = (0, 71, np.eye(4))
    assert loop_metrics([into_saved], truth, 60)["loops/recall"] == 0.0, "frames 82 to 91 are found by nothing"
    assert loop_metrics([into_saved, between(11, 91, truth)], truth, 60)["loops/recall"] == 1.0


def wall(offset: float, size: int = 20, facing: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A grid of Gaussians 5 cm apart on z = offset, 1 cm thick."""
    x, y = np.meshgrid(0.05 * np.arange(size), 0.05 * np.arange(size))
    means = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, offset)])
    normals = np.tile([0.0, 0.0, facing], (x.size, 1))
    return means, normals, np.tile(np.diag([0.03, 0.03, 0.01]) ** 2, (x.size, 1, 1))


def both(*walls: tuple[np.ndarray, np.ndarray, np.ndarray]) -> tuple[np.ndarray, ...]:
    return tuple(map(np.concatenate, zip(*walls, strict=True)))


@pytest.mark.parametrize(
    ("gap", "share"),
    [(0.015, 0.0), (0.025, 1.0), (0.08, 1.0), (0.14, 1.0), (0.16, 0.0)],  # two standard deviations are 2 cm
)
def test_a_second_layer_counts_between_two_deviations_and_15_cm(gap, share):
    assert double_wall_share(*both(wall(0.0), wall(gap))) == share


def test_only_what_has_another_behind_it_counts_and_a_lone_gaussian_has_no_share():
    assert double_wall_share(*wall(0.0)) == 0.0
    assert double_wall_share(*both(wall(0.0), wall(0.08, size=10))) == pytest.approx(2 * 100 / 500, abs=0.05)
    assert double_wall_share(*(rows[:1] for rows in wall(0.0))) is None


def test_the_two_sides_of_a_board_and_a_slope_are_no_double_wall():
    assert double_wall_share(*both(wall(0.0), wall(0.05, facing=-1.0))) == 0.0
    means, normals, covs = wall(0.05)
    tilted = normals @ np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 1.0]]) / np.sqrt(2.0)
    assert double_wall_share(*both(wall(0.0), (means, tilted, covs))) == 0.0
    turn = np.array([[0.8, 0.0, -0.6], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]])
    assert double_wall_share(means @ turn.T, normals @ turn.T, turn @ covs @ turn.T) == 0.0


@pytest.mark.parametrize("unit", [0.001, 1.0, 1000.0])
def test_where_no_metre_is_known_a_layer_counts_by_how_far_gaussians_stand_apart(unit):
    means, normals, covs = both(wall(0.0), wall(0.08))
    assert double_wall_share(unit * means, normals, unit**2 * covs, None) == 1.0
    assert double_wall_share(unit * means, normals, unit**2 * covs, unit) == 1.0
    means, normals, covs = both(wall(0.0), wall(0.22))
    assert double_wall_share(unit * means, normals, unit**2 * covs, None) == 0.0

"""Double walls: planes at known distances, as thick as they are said to be."""

import numpy as np
import pytest

from emgs_jax.evaluation.layers import double_wall_share


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

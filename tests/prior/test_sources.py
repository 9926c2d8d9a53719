"""Which views a view is matched against: parallax, and nothing that no view shows."""

from itertools import combinations

import numpy as np
from stereo_scene import matrix

from emgs_jax.prior.sources import choose, parallax, sources_of
from emgs_jax.structure.model import Structure


def test_sources_have_their_poses_and_fewer_than_asked_for_are_repeated_without_counting():
    poses = np.stack([matrix((0, 0.1 * row, 0), (row, 0, 0)) for row in range(3)])
    found = Structure([], np.zeros(3, int), poses, np.zeros((3, 6, 6)), [np.arange(0)] * 3)
    sources = sources_of(found, 0, [2, 1], 3, lambda frame: np.full(2, frame))
    np.testing.assert_array_equal(sources.views, [[2, 2], [1, 1], [2, 2]])
    np.testing.assert_array_equal(sources.is_used, [True, True, False])
    expected = np.linalg.inv(poses[[2, 1, 2]]) @ poses[0]
    np.testing.assert_allclose(sources.T_source_view.as_matrix(), expected, atol=1e-6)


def test_the_parallax_is_the_sine_of_the_angle_between_the_rays():
    points = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 1.0], [2.0, 0.0, 0.0]])
    expected = [1 / np.sqrt(5), 1 / np.sqrt(2), 0.0]  # the third lies on the line through both cameras
    np.testing.assert_allclose(parallax(points, np.zeros(3), np.array([1.0, 0, 0])), expected, atol=1e-12)


def test_the_side_to_which_the_camera_turns_has_its_sources_and_most_parallax_is_chosen_best_first():
    """Symptom: four old views with wide baselines, none of which showed the right half of the image."""
    left, right = np.repeat([1.0, 0.0], [45, 45]), np.repeat([0.0, 1.0], [45, 45])
    worth = {index: 0.9 * left for index in range(4)} | {9: 0.1 * left + 0.3 * right}
    assert sorted(choose(worth, 4)) == [0, 1, 2, 9]
    worth = {index: np.full(20, value) for index, value in enumerate((0.2, 0.9, 0.5, 0.7, 0.0))}
    assert choose(worth, 2) == [1, 3]
    assert choose(worth, 9) == [1, 3, 2, 0]  # the last shows nothing
    assert choose({}, 3) == [] and choose({1: np.zeros(0)}, 3) == []


def test_the_choice_is_nearly_the_best_of_all():
    rng = np.random.default_rng(0)
    for _ in range(20):
        worth = dict(enumerate(rng.uniform(size=(7, 40)) * (rng.uniform(size=(7, 40)) < 0.3)))

        def value(views, worth=worth):
            return np.sqrt(sum(worth[view] for view in views)).sum()

        best = max(value(views) for views in combinations(worth, 3))
        assert value(choose(worth, 3)) >= (1 - 1 / np.e) * best

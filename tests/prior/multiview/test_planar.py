"""Blank walls become planes where their matches say so, and are left alone where these do not."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from stereo_scene import CENTER, SIZE, depth_config, painted, planar_config, small_camera, sources

from emgs_jax.prior.multiview.depth import estimate_depth
from emgs_jax.prior.multiview.planar import (
    _filled,
    _prediction_std,
    blank_regions,
    fill_planes,
    fit_plane,
    fit_planes,
)

pytestmark = pytest.mark.slow


WIDTH, HEIGHT = SIZE
SPACING = 0.03  # 1/m, of the planes of the sweep
V, U = np.mgrid[:HEIGHT, :WIDTH]
WALL = (np.abs(U - CENTER[0]) < 20) & (np.abs(V - CENTER[1]) < 15)
INNER = (np.abs(U - CENTER[0]) < 14) & (np.abs(V - CENTER[1]) < 9)
TRUE = 1.0 / (0.5 + 0.004 * (U - 30) - 0.003 * (V - 20))  # a plane: the inverse is linear in the pixel


def painted_around(wall: np.ndarray) -> np.ndarray:
    return np.float32(np.where(wall, 0.6, np.random.default_rng(0).uniform(size=wall.shape)))


def with_a_hollow(wrong: float, noise: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Depth and spread of `TRUE` with noise (in planes), and `wrong` times the depth, uncertain, inside the wall."""
    error = noise * SPACING * np.random.default_rng(1).normal(size=TRUE.shape)
    depth = np.where(INNER, wrong * TRUE, 1.0 / (1.0 / TRUE + error))
    return np.float32(depth), np.float32(np.where(INNER, 8.0, 0.5))


@pytest.mark.parametrize("wrong", [0.0, 0.7, 3.0])  # a hole, before the wall, and metres behind it
def test_a_blank_wall_is_the_plane_of_the_matches_around_its_middle(wrong):
    depth, spread = with_a_hollow(wrong)
    found, certain = fill_planes(depth, spread, painted_around(WALL), SPACING, planar_config())
    np.testing.assert_allclose(found[INNER], TRUE[INNER], rtol=0.02)
    assert certain[INNER].max() < 0.5
    outside = ~WALL
    np.testing.assert_allclose(found[outside], depth[outside], rtol=1e-6)  # two reciprocals
    np.testing.assert_array_equal(certain[outside], spread[outside])


@pytest.mark.parametrize("slope", [0.0, 0.4])
def test_the_depth_of_images_of_a_blank_wall_in_a_painted_frame_is_within_2_percent(slope):
    gray, depth, others = painted(slope, blank=0.45)
    seen = jnp.asarray(gray), sources(others), jnp.asarray([1.2, 5.0]), small_camera()
    found, spread = (np.asarray(a) for a in eqx.filter_jit(estimate_depth)(*seen, depth_config()))
    blank, spacing = gray == 0.5, (1 / 1.2 - 1 / 5.0) / 23
    filled, certain = fill_planes(found, spread, gray, spacing, planar_config())
    error, before = (np.abs(z / depth - 1)[blank] for z in (filled, found))
    assert error.max() < 0.02 and error.max() < before.max()
    assert np.mean(certain[blank]) < np.mean(spread[blank])


@pytest.mark.parametrize("why", ["uncertain", "few", "noise", "line"])
def test_without_matches_that_lie_on_planes_a_wall_stays_as_uncertain_as_it_was(why):
    depth, spread = with_a_hollow(0.7, noise=0.0 if why == "line" else 0.3)
    rim = WALL & ~INNER
    if why == "uncertain":
        spread[rim] = 3.0
    elif why == "few":
        depth[rim & (U > 15)] = 0.0
    elif why == "line":
        spread[WALL] = 8.0
        spread[WALL & (U == 25)] = 0.5
    else:
        depth = np.where(rim, np.random.default_rng(2).uniform(1, 6, depth.shape), depth)
    overrides = {"few": ("prior.dense.planar.min_matches=250",), "line": ("prior.dense.planar.min_matches=10",)}.get(
        why, ()
    )
    found, certain = fill_planes(depth, spread, painted_around(WALL), SPACING, planar_config(*overrides))
    np.testing.assert_allclose(found, depth, rtol=1e-6)
    np.testing.assert_array_equal(certain, spread)


def test_two_planes_of_one_paint_that_meet_are_both_found_up_to_their_crease():
    """A ceiling and a beam: neither has enough of the matches alone."""
    bent = 1.0 / (1.0 / TRUE + 0.02 * np.maximum(U - CENTER[0], 0.0))
    depth, spread = with_a_hollow(0.7)
    depth = np.where(INNER, depth, 1.0 / (1.0 / depth - 1.0 / TRUE + 1.0 / bent))
    found, certain = fill_planes(np.float32(depth), spread, painted_around(WALL), SPACING, planar_config())
    np.testing.assert_allclose(found[INNER], bent[INNER], rtol=0.05)  # a pixel off at the crease
    assert np.median(np.abs(found / bent - 1)[INNER]) < 0.01
    assert certain[INNER].max() < 4.0  # it was 8
    assert not np.allclose(bent[INNER], TRUE[INNER], rtol=0.1)  # one plane would not do


def test_between_two_planes_that_do_not_meet_the_depth_stays_as_uncertain_as_it_was():
    depth, spread = with_a_hollow(0.7)
    right = CENTER[0] < U
    depth = np.where(~INNER & right, 0.5 * depth, depth)
    found, certain = fill_planes(np.float32(depth), spread, painted_around(WALL), SPACING, planar_config())
    middle = INNER & (np.abs(U - CENTER[0]) < 2) & (np.abs(V - CENTER[1]) < 6)
    np.testing.assert_allclose(found[middle], depth[middle], rtol=1e-6)
    np.testing.assert_array_equal(certain[middle], spread[middle])
    for side, true in ((~right, TRUE), (right, 0.5 * TRUE)):
        near = INNER & side & (np.abs(U - CENTER[0]) > 12)
        np.testing.assert_allclose(found[near], true[near], rtol=0.03)
        assert (certain[near] > 0.5).all()  # less certain than on a wall of one plane


def test_a_more_certain_match_is_kept():
    depth, spread = with_a_hollow(0.7)
    knob = (np.abs(U - 30) < 3) & (np.abs(V - 24) < 3)
    depth[knob], spread[knob] = 0.9, 0.01
    found, certain = fill_planes(depth, spread, painted_around(WALL), SPACING, planar_config())
    np.testing.assert_allclose(found[knob], 0.9, rtol=1e-6)
    np.testing.assert_allclose(found[INNER & ~knob], TRUE[INNER & ~knob], rtol=0.02)


def test_where_a_plane_lies_behind_the_camera_the_depth_stays():
    """The inverse depth of the wall's plane falls below 0 on its right side."""
    steep, matched = 0.6 - 0.03 * U, U < 15
    depth = np.where(matched, 1.0 / np.where(matched, steep, 1.0), 2.0)
    found, _ = fill_planes(depth, np.where(matched, 0.5, 8.0), painted_around(WALL), SPACING, planar_config())
    np.testing.assert_allclose(found[WALL & (U > 20)], 2.0, rtol=1e-6)
    np.testing.assert_allclose(found[WALL & (U < 19)], 1.0 / steep[WALL & (U < 19)], rtol=1e-6)


def test_the_plane_is_that_of_the_majority():
    rng, truth = np.random.default_rng(3), np.array([5.0, -3.0, 12.0])
    pixels = np.column_stack([rng.uniform(-0.5, 0.5, (200, 2)), np.ones(200)])
    inverse = pixels @ truth + 0.1 * rng.normal(size=200)
    wrong = np.arange(200) < 60
    inverse[wrong] += rng.uniform(3, 20, 60)
    plane, chosen = fit_plane(pixels, inverse, planar_config())
    expected = np.linalg.lstsq(pixels[~wrong], inverse[~wrong], rcond=None)[0]
    np.testing.assert_array_equal(chosen, ~wrong)
    np.testing.assert_allclose(plane, expected, atol=1e-9)


@pytest.mark.parametrize(("num_scattered", "count"), [(45, 1), (60, 0)])
def test_scattered_matches_are_no_further_plane(num_scattered, count):
    """Of 200; three quarters must lie on planes of at least 50, and some of the scattered ones always agree."""
    rng = np.random.default_rng(5)
    pixels = np.column_stack([rng.uniform(-0.5, 0.5, (200, 2)), np.ones(200)])
    inverse = pixels @ [5.0, -3.0, 12.0]
    inverse[:num_scattered] += rng.uniform(3, 20, num_scattered)
    assert len(fit_planes(pixels, inverse, planar_config())) == count


def test_between_two_planes_the_odds_are_those_of_the_squared_distances_to_their_matches():
    """Without errors, matched at either end: the one that is not taken is as far away as it lies from the other."""
    v, u = np.mgrid[:20, :41]
    near, pixels = (u < 3) | (u > 37), np.stack([u / 41 - 0.5, v / 41 - 0.5, np.ones(u.shape)], -1)
    first, second = 20.0 + 30.0 * pixels[..., 1], 24.0 - 30.0 * pixels[..., 1]
    truth = np.where(u < 20, first, second)
    config = planar_config("prior.dense.planar.tolerance=0.001")
    found, std = (values.reshape(u.shape) for values in _filled(u >= 0, near, pixels, truth, config))
    away = u != 20
    np.testing.assert_allclose(found[away], truth[away])
    gap, (to_first, to_second) = np.abs(first - second), np.maximum([u - 2.0, 38.0 - u], 0.5)
    far, close = np.maximum(to_first, to_second), np.minimum(to_first, to_second)
    np.testing.assert_allclose(std, gap * np.sqrt(far**-2 / (far**-2 + close**-2)), rtol=1e-5)


@pytest.mark.parametrize("correlation", [1.0, 3.0])
def test_the_prediction_has_the_spread_of_repeated_fits(correlation):
    """Oracle: 4000 fits to errors that groups of c² matches share, and a new error at the predicted pixel."""
    rng, groups, size = np.random.default_rng(4), 30, int(correlation) ** 2
    places = np.column_stack([rng.uniform(-0.2, 0.2, (groups, 2)), np.ones(groups)])
    at = np.array([[0.0, 0.0, 1.0], [0.4, 0.1, 1.0]])
    errors = 0.3 * rng.normal(size=(groups, 4000))
    predicted = at @ np.linalg.lstsq(places, errors, rcond=None)[0] + 0.3 * rng.normal(size=(2, 4000))
    config = planar_config(f"prior.dense.planar.correlation={correlation}")
    std = _prediction_std(at, np.repeat(places, size, axis=0), np.full(groups * size, 0.3), config)
    np.testing.assert_allclose(std, predicted.std(axis=1), rtol=0.05)  # 4000 draws: 1.1 %
    assert std[1] > 1.1 * std[0]  # far from the matches


def test_blank_regions_are_connected_large_and_without_edges():
    gray = painted_around(WALL)
    gray[WALL & (U >= 30)] = 0.7  # an edge
    gray[:4, :4] = 0.1  # too small
    regions = list(blank_regions(gray, planar_config()))
    assert len(regions) == 2
    np.testing.assert_array_equal(regions[0] | regions[1], WALL)
    assert not (regions[0] & regions[1]).any()

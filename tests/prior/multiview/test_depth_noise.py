"""The standard deviation of a depth: σ_z / z = z σ_px / (f b) beside a baseline, none without one, and its parts."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from stereo_scene import matrix, sources

from emgs_jax.ops.camera import Camera
from emgs_jax.prior.multiview.depth import mean_difference, pixels_per_log_depth
from emgs_jax.prior.multiview.depth_noise import DepthNoiseConfig, relative_std

FOCAL, WIDTH, HEIGHT = 55.0, 64, 48
CONFIG = DepthNoiseConfig(pixel_std=0.5, spread_std=2.0, difference_std=3.0, max_std=0.1)
DEPTH_STEP = np.float32(0.02)
NOTHING = np.zeros((HEIGHT, WIDTH))
jitted_pixels, jitted_difference = eqx.filter_jit(pixels_per_log_depth), eqx.filter_jit(mean_difference)


def camera():
    return Camera([FOCAL, FOCAL], [31.5, 23.5], WIDTH, HEIGHT)


def moved(*translations, turn=(0.0, 0.0, 0.0)):
    """Cameras that stand there."""
    return [matrix(turn, translation) for translation in translations]


def pixels(depth, poses, is_used=None):
    return np.asarray(jitted_pixels(plane(depth), sources(None, poses, is_used), camera()))


def plane(depth):
    return jnp.asarray(np.full_like(NOTHING, depth), jnp.float32)


@pytest.mark.parametrize("baseline", [0.05, 0.2])
def test_the_noise_of_a_depth_grows_with_its_square_over_focal_length_and_baseline(baseline):
    for depth in (1.0, 2.0, 4.0):
        std = depth * relative_std(pixels(depth, moved((baseline, 0, 0))), NOTHING, NOTHING, CONFIG)
        is_shown = np.isfinite(std)
        np.testing.assert_allclose(std[is_shown], depth**2 * CONFIG.pixel_std / (FOCAL * baseline), rtol=1e-3)
        lost = round(FOCAL * baseline / depth)  # columns that the source does not show
        assert (~is_shown).any(axis=0).sum() == pytest.approx(lost, abs=1)


def test_the_source_with_the_longest_baseline_counts_if_it_is_used():
    T = moved((0.05, 0, 0), (0, 0.2, 0))
    middle = np.s_[20:28, 20:44]
    for is_used, baseline in (((True, True), 0.2), ((True, False), 0.05)):
        np.testing.assert_allclose(pixels(2.0, T, is_used)[middle], FOCAL * baseline / 2.0, rtol=1e-3)


def test_a_camera_that_only_turns_or_sees_nothing_of_it_tells_no_depth():
    aside = moved((0, 0, 0), turn=(0, 0.2, 0))
    behind = moved((0.2, 0, 0), turn=(0, np.pi, 0))
    for T in (aside, behind):
        std = relative_std(pixels(2.0, T), NOTHING, NOTHING, CONFIG)
        assert (std > 1e3).all()
    assert np.isinf(relative_std(pixels(0.0, moved((0.2, 0, 0))), NOTHING, NOTHING, CONFIG)).all()


def test_parts_add_as_variances():
    found = relative_std(np.array([[5.0]]), np.array([[0.02]]), np.array([[0.01]]), CONFIG)
    np.testing.assert_allclose(found, np.sqrt(0.1**2 + 0.04**2 + 0.03**2), rtol=1e-6)
    for spread, difference in ((np.inf, 0.0), (0.0, np.inf)):
        assert np.isinf(relative_std(np.array([[5.0]]), np.array([[spread]]), np.array([[difference]]), CONFIG))


def difference(depth, others, is_used=None, poses=None):
    seen = sources(others, poses or moved(*[(0, 0, 0)] * len(others)), is_used)
    return np.asarray(jitted_difference(plane(depth), seen, camera(), DEPTH_STEP))


@pytest.mark.parametrize("size", [0.1, 1.0, 10.0])
def test_views_that_all_differ_by_a_fraction_differ_by_that_in_every_unit(size):
    for share in (-0.06, 0.01, 0.04):
        found = difference(size * (1 + share), [plane(size)] * 4)
        np.testing.assert_allclose(found, abs(share), rtol=1e-3)


def test_a_view_that_confirms_nothing_counts_as_one_however_wrong_it_is_and_one_that_is_not_used_does_not():
    none, far = plane(0.0), plane(9.0)
    for other in (none, far):
        np.testing.assert_allclose(difference(2.0, [plane(2.0), other]), float(DEPTH_STEP) * np.log(2.0), rtol=1e-4)
        np.testing.assert_allclose(difference(2.0, [plane(2.0), other], (True, False)), 0.0, atol=1e-6)
    assert np.isinf(difference(2.0, [none, none])).all() and np.isinf(difference(0.0, [plane(2.0)] * 2)).all()
    turned, beside = moved((0, 0, 0), turn=(0, np.pi, 0)), moved((30.0, 0, 0))
    assert all(np.isinf(difference(2.0, [plane(2.0)], poses=poses)).all() for poses in (turned, beside))

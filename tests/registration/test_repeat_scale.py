"""What the image that was predicted twice says of the scale, and how sure that is."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene import device, moved_points, observe_room, on_host, path_pose, pose, predict_room, replace

from emgs_jax.observation import transform
from emgs_jax.ops.camera import Camera
from emgs_jax.registration.repeated_prediction import mean_depth_of, repeat_error, repeat_scale

CAMERA = Camera([30.0, 33.0], [19.5, 15.25], 40, 32)
T, NOW = path_pose(2), observe_room(path_pose(2), CAMERA)
NUM_PIXELS, RATIO = CAMERA.height * CAMERA.width, device(1.0)


@on_host
@eqx.filter_vmap
def scales_of(log_ratios):
    """Of a prediction before that is larger by these, one row of pixels a draw."""
    larger = eqx.tree_at(lambda o: o.points, NOW, NOW.points * jnp.exp(log_ratios)[..., None])
    return repeat_scale(NOW, transform(T, larger, jnp.ones(())), T, jnp.ones(()), RATIO)


def normal(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=shape)


def test_the_same_to_the_bit_is_certain():
    scale, std = scales_of(np.full((200, NUM_PIXELS), np.log(1.1), np.float32))
    assert scale[0] == pytest.approx(1.1, rel=1e-5) and std[0] < 1e-6


@pytest.mark.parametrize("true", [0.01, 50.0])
def test_a_ratio_is_found_however_small_or_large(true):
    scale, std = scales_of(np.full((200, NUM_PIXELS), np.log(true), np.float32))
    assert scale[0] == pytest.approx(true, rel=1e-4) and std[0] < 1e-5


def test_points_beside_the_axis_count_and_those_behind_the_camera_do_not():
    left, behind = np.asarray(NOW.points)[:, 0] < 0, np.arange(NUM_PIXELS) % 2 == 0
    before = moved_points(T, replace(NOW, points=np.where(behind[:, None], 5.0, 1.2) * np.asarray(NOW.points)))
    now = replace(NOW, points=np.where(behind[:, None], -1.0, 1.0) * np.asarray(NOW.points), valid=left)
    scale, _ = on_host(repeat_scale)(now, before, T, device(1.0), RATIO)
    assert scale == pytest.approx(1.2, rel=1e-5)


def test_the_deviation_is_that_of_the_scales_where_pixels_err_apart():
    scale, std = scales_of(np.float32(0.05 * normal(200, NUM_PIXELS)))
    assert np.mean(std) == pytest.approx(np.std(np.log(scale)), rel=0.25)


def test_the_deviation_is_that_of_the_scales_where_regions_err_alike():
    """Eight by eight pixels share an error: the scale is worth as many measurements as there are such regions."""
    regions = 0.05 * normal(200, CAMERA.height // 8, CAMERA.width // 8)
    log_ratios = np.repeat(np.repeat(regions, 8, axis=1), 8, axis=2).reshape(200, -1)
    scale, std = scales_of(np.float32(log_ratios))
    assert np.mean(std) == pytest.approx(np.std(np.log(scale)), rel=0.4)


def test_without_a_pair_the_other_scale_stands():
    """A depth of 1e-30 m is none: the scale by which it would be one of the map overflows."""
    before = moved_points(T, NOW)
    blind = replace(before, valid=np.zeros(NUM_PIXELS, bool))
    for now, seen in ((NOW, blind), (replace(NOW, points=1e-30 * np.asarray(NOW.points)), before)):
        scale, std = on_host(repeat_scale)(now, seen, T, np.float32(0.8), RATIO)
        assert scale == pytest.approx(0.8) and np.isfinite(std)


@pytest.mark.slow
@pytest.mark.parametrize("poison", [0.0, np.nan, 1e30])
def test_a_row_that_is_no_point_says_nothing(poison):
    """A depth of 0 in both predictions made the error of the scale, and with it the whole state, NaN."""
    points, valid = np.array(NOW.points), np.arange(NUM_PIXELS) != 7
    points[7] = poison
    bad, good = replace(NOW, points=points), replace(NOW, points=np.where(valid[:, None], points, 1), valid=valid)
    found, expected = (repeat_scale(one, moved_points(T, one), T, jnp.ones(()), RATIO) for one in (bad, good))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-7)


def test_what_two_equal_predictions_differ_by_has_finite_slopes():
    """A length has none at 0: those of a whole step with an exact prior were NaN."""
    before = jax.tree.map(device, moved_points(T, NOW))

    def total(points):
        same = eqx.tree_at(lambda o: o.points, before, points)
        return repeat_error(before, same, pose(), jnp.ones(()), jnp.ones(()))

    assert np.isfinite(on_host(jax.grad(total))(before.points)).all()


@pytest.mark.parametrize(
    ("factor", "expected"), [(1.0, float(np.sort(np.asarray(NOW.points)[:, 2])[639])), (0.0, 1.0), (1e-30, 1.0)]
)
def test_the_mean_depth_is_the_median_of_the_points_before_the_camera(factor, expected):
    """Where all points were at the camera, depths were a part of 0 and the whole state NaN."""
    now = replace(NOW, points=factor * np.asarray(NOW.points))
    found = eqx.tree_at(lambda p: (p.previous, p.current), predict_room(2, CAMERA), (now, now))
    assert on_host(mean_depth_of)(found) == pytest.approx(expected)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_where_the_previous_image_shows_nothing_the_mean_depth_is_that_of_this_one(unit):
    """It was 1, whatever the unit: gates and deviations after a black frame were those of a room of a metre."""
    found = eqx.tree_at(lambda p: p.previous.valid, predict_room(2, CAMERA, scale=unit), np.zeros(NUM_PIXELS, bool))
    depths = np.sort(np.asarray(NOW.points)[:, 2])
    assert on_host(mean_depth_of)(found) == pytest.approx(unit * depths[(NUM_PIXELS - 1) // 2])

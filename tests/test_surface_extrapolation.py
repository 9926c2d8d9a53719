"""What is new goes on where the map ends: a wall that a frame shows too far away."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene import device, flat_gaussians, fresh_map, matrix_of, on_host, pose, replace

from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.observation import Observation
from emgs_jax.ops.camera import Camera
from emgs_jax.surface_extrapolation import ExtrapolationConfig, depth_error, extrapolate, window

HEIGHT, WIDTH = 12, 16
CAMERA = Camera([16.0, 16.0], [7.5, 5.5], WIDTH, HEIGHT)
HALF = np.tile(np.arange(WIDTH) < WIDTH // 2, HEIGHT)  # the map has the left half of the wall
T = pose((0.1, -0.2, 0.3), (1.0, 2.0, 3.0))
TURN, PLACE = matrix_of(T)[:3, :3], matrix_of(T)[:3, 3]
goes_on, error_of = on_host(extrapolate), on_host(depth_error)


def config(width: float = 0.2, max_error: float = 0.3, min_cos: float = 0.3) -> ExtrapolationConfig:
    return ExtrapolationConfig(*map(device, (width, max_error, min_cos)))


def rays() -> np.ndarray:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([(u - 7.5) / 16, (v - 5.5) / 16, np.ones_like(u)], axis=-1).reshape(-1, 3)


def seen(depth: np.ndarray | float) -> Observation:
    """A frame of the wall z = 2 m, with the given depth (m) of every pixel."""
    count = HEIGHT * WIDTH
    points = rays() * np.broadcast_to(depth, count)[:, None] @ TURN.T + PLACE
    normals = np.tile(TURN @ [0.0, 0.0, -1.0], (count, 1))
    arrays = points, np.zeros((count, 3)), normals, np.zeros((count, 0)), np.ones(count), np.ones(count, bool)
    return Observation(*map(device, arrays))


def wall(weight: float, normal: tuple[float, float, float] = (0.0, 0.0, -1.0)) -> GaussianMap:
    """The Gaussian of every pixel, at 2 m."""
    return fresh_map(flat_gaussians(rays() * 2.0 @ TURN.T + PLACE, normal=TURN @ normal), weight)


def moved(frame: Observation, map: GaussianMap, noise=0.02, is_fused=HALF, **changes) -> np.ndarray:
    """The points, camera frame."""
    noise = np.float32(np.broadcast_to(noise, HALF.shape))
    points = goes_on(frame, map, is_fused, noise, T, CAMERA, config(**changes)).points
    return (points - PLACE) @ TURN


def depth_after(*arguments, **changes) -> np.ndarray:
    return moved(*arguments, **changes)[:, 2]


def test_a_wall_that_is_seen_too_far_goes_on_where_the_map_ends() -> None:
    depth = depth_after(seen(2.0 * 1.1), wall(weight=1e6)).reshape(HEIGHT, WIDTH)
    np.testing.assert_allclose(depth[:, : WIDTH // 2], 2.2, rtol=1e-5)  # what EM fuses stays
    np.testing.assert_allclose(depth[2:-2, WIDTH // 2], 2.0, atol=0.02)
    assert np.all(np.diff(depth[5, WIDTH // 2 :]) > 0)  # the farther from the map, the less it tells


def test_points_move_along_their_rays_as_the_formula_says() -> None:
    """Little of the errors is alike, points and map are known differently well, and some points are not valid."""
    rng, count = np.random.default_rng(1), HEIGHT * WIDTH
    v, u = np.divmod(np.arange(count), WIDTH)
    error = 0.004 * np.sin(u / 5) + 0.06 * rng.normal(size=count)
    noise, weight = rng.uniform(0.01, 0.03, count), rng.uniform(0.5, 5.0, count)
    is_fused, valid = rng.uniform(size=(2, count)) < [[0.6], [0.8]]
    frame = replace(seen(2.0 * np.exp(error)), valid=valid | is_fused)
    near = np.exp(-0.5 * ((u - u[:, None]) ** 2 + (v - v[:, None]) ** 2) / (0.2 * WIDTH) ** 2)
    precision = is_fused * (noise[is_fused].min() / noise) ** 2
    alone = (near @ (precision * error) - precision * error) / (1 + near @ precision - precision)
    slope = np.sum(precision * error * alone) / np.sum(precision * alone**2)
    assert 0.2 < slope < 0.8
    expected = slope * (near @ (precision * error * weight / (weight + 1))) / (1 + near @ precision)
    depth = 2.0 * np.exp(error - np.where(valid & ~is_fused, expected, 0.0))
    np.testing.assert_allclose(moved(frame, wall(weight), noise, is_fused), rays() * depth[:, None], atol=2e-5)


def test_errors_that_are_not_alike_move_nothing() -> None:
    sign = np.where((np.arange(HEIGHT)[:, None] + np.arange(WIDTH)) % 2, 1.0, -1.0).reshape(-1)
    depth = depth_after(seen(2.0 * np.exp(0.05 * sign)), wall(1e6))
    np.testing.assert_allclose(depth, 2.0 * np.exp(0.05 * sign), rtol=1e-5)


def test_as_printed_and_with_nothing_fused_no_bit_changes() -> None:
    frame, noise = seen(2.2), np.full(HALF.shape, 0.02, np.float32)
    for is_fused, settings in ((HALF, config(width=0.0)), (np.zeros_like(HALF), config())):
        found = goes_on(frame, wall(1e6), is_fused, noise, T, CAMERA, settings)
        np.testing.assert_array_equal(found.points, frame.points)


def test_an_exact_frame_without_noise_stays_finite_and_where_it_is() -> None:
    np.testing.assert_allclose(depth_after(seen(2.0), wall(1e6), noise=0.0), 2.0, rtol=1e-5)


def test_what_is_another_surface_or_is_seen_flat_has_no_error() -> None:
    frame, everywhere, center = seen(2.2), np.ones(HEIGHT * WIDTH, bool), np.float32(PLACE)
    error, is_known = error_of(frame.points, wall(1.0), everywhere, center, config())
    assert is_known.all()
    np.testing.assert_allclose(error, np.log(1.1), rtol=1e-4)
    error, is_known = error_of(frame.points, wall(1.0), everywhere, center, config(max_error=0.05))
    assert not is_known.any() and not np.any(error)
    flat = wall(1.0, normal=(1.0, 0.0, 0.0))
    _, is_known = error_of(frame.points, flat, everywhere, center, config(min_cos=0.5))
    assert not is_known.any()


def test_window_is_gaussian_and_the_identity_without_width() -> None:
    weights = on_host(window)
    np.testing.assert_array_equal(weights(4, np.float32(0.0)), np.eye(4))
    np.testing.assert_allclose(weights(4, np.float32(2.0))[0], np.exp(-(np.arange(4) ** 2) / 8.0), rtol=1e-6)


@pytest.mark.parametrize("count", [0, 1, HALF.sum()])
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_slopes_are_finite_however_few_points_are_fused(count, noise):
    is_fused = device(HALF & (np.cumsum(HALF) <= count))
    frame, map = seen(2.1), wall(weight=3.0)

    def total(noise, points, weight):
        given = eqx.tree_at(lambda o: o.points, frame, points), eqx.tree_at(lambda m: m.weight, map, weight)
        moved = extrapolate(*given, is_fused, noise, T, CAMERA, config())
        return jnp.sum(moved.points**2)

    given = device(np.full(HALF.shape, noise)), frame.points, map.weight
    assert all(np.isfinite(slope).all() for slope in on_host(jax.grad(total, (0, 1, 2)))(*given))

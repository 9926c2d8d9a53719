"""What is new goes on where the map ends: a wall that a frame shows too far away."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from emgs_jax.continuation import ContinuationConfig, continued, depth_error, window
from emgs_jax.gaussian_map import GaussianMap, empty_map
from emgs_jax.observation import Observation
from emgs_jax.ops.camera import Camera

HEIGHT, WIDTH = 12, 16
CAMERA = Camera(focal=jnp.array([16.0, 16.0]), center=jnp.array([7.5, 5.5]), width=WIDTH, height=HEIGHT)
HALF = jnp.tile(jnp.arange(WIDTH) < WIDTH // 2, HEIGHT)  # the map has the left half of the wall
T = jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.exp(jnp.array([0.1, -0.2, 0.3])), jnp.array([1.0, 2.0, 3.0]))


def config(width: float = 0.2, max_error: float = 0.3, min_cos: float = 0.3) -> ContinuationConfig:
    return ContinuationConfig(*map(jnp.asarray, (width, max_error, min_cos)))


def rays() -> np.ndarray:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([(u - 7.5) / 16, (v - 5.5) / 16, np.ones_like(u)], axis=-1).reshape(-1, 3)


def seen(depth: np.ndarray | float) -> Observation:
    """A frame of the wall z = 2 m, with the given depth (m) of every pixel."""
    points = T.apply(jnp.asarray(rays() * np.broadcast_to(depth, HEIGHT * WIDTH)[:, None], jnp.float32))
    count = HEIGHT * WIDTH
    normals = jnp.broadcast_to(T.rotation().apply(jnp.array([0.0, 0.0, -1.0])), (count, 3))
    nothing = jnp.zeros((count, 3))
    return Observation(points, nothing, normals, jnp.zeros((count, 0)), jnp.ones(count), jnp.ones(count, bool))


def wall(weight: float, normal: tuple[float, float, float] = (0.0, 0.0, -1.0)) -> GaussianMap:
    """The Gaussian of every pixel, at 2 m."""
    count = HEIGHT * WIDTH
    means = T.apply(jnp.asarray(rays() * 2.0, jnp.float32))
    normals = jnp.broadcast_to(T.rotation().apply(jnp.asarray(normal)), (count, 3))
    changed = (means, normals, jnp.full(count, weight))
    return eqx.tree_at(lambda m: (m.gaussians.means, m.gaussians.normals, m.weight), empty_map(count, 0), changed)


def depth_after(frame: Observation, map: GaussianMap, noise=0.02, **changes) -> np.ndarray:
    noise = jnp.broadcast_to(jnp.asarray(noise), HALF.shape)
    found = continued(frame, map, HALF, noise, T, CAMERA, config(**changes))
    return np.asarray(T.inverse().apply(found.points))[:, 2]


def test_a_wall_that_is_seen_too_far_goes_on_where_the_map_ends() -> None:
    depth = depth_after(seen(2.0 * 1.1), wall(weight=1e6)).reshape(HEIGHT, WIDTH)
    np.testing.assert_allclose(depth[:, : WIDTH // 2], 2.2, rtol=1e-5)  # what EM fuses stays
    np.testing.assert_allclose(depth[2:-2, WIDTH // 2], 2.0, atol=0.02)
    assert np.all(np.diff(depth[5, WIDTH // 2 :]) > 0)  # the farther from the map, the less it tells


def test_points_move_along_their_rays_only() -> None:
    found = continued(seen(2.2), wall(1e6), HALF, jnp.full(HALF.shape, 0.02), T, CAMERA, config())
    local = np.asarray(T.inverse().apply(found.points))
    np.testing.assert_allclose(local / local[:, 2:], rays(), atol=1e-5)


@pytest.mark.parametrize("weight", [1.0, 3.0])
def test_the_share_of_a_young_map_in_the_difference_is_its_own(weight: float) -> None:
    old, young = (np.log(depth_after(seen(2.2), wall(w)) / 2.2)[~np.asarray(HALF)] for w in (1e9, weight))
    np.testing.assert_allclose(young, old * weight / (weight + 1), rtol=2e-2, atol=1e-4)


def test_errors_that_are_not_alike_move_nothing() -> None:
    sign = np.where((np.arange(HEIGHT)[:, None] + np.arange(WIDTH)) % 2, 1.0, -1.0).reshape(-1)
    depth = depth_after(seen(2.0 * np.exp(0.05 * sign)), wall(1e6))
    np.testing.assert_allclose(depth, 2.0 * np.exp(0.05 * sign), rtol=1e-5)


def test_as_printed_and_with_nothing_fused_no_bit_changes() -> None:
    frame, noise = seen(2.2), jnp.full(HALF.shape, 0.02)
    for is_fused, settings in ((HALF, config(width=0.0)), (jnp.zeros_like(HALF), config())):
        found = continued(frame, wall(1e6), is_fused, noise, T, CAMERA, settings)
        np.testing.assert_array_equal(found.points, frame.points)


def test_uncertain_points_tell_less() -> None:
    rows = np.arange(HEIGHT * WIDTH) // WIDTH
    depth = 2.0 * np.where(rows % 2, 1.1, 1.0)  # every other row errs
    even = depth_after(seen(depth), wall(1e6))
    known = depth_after(seen(depth), wall(1e6), noise=np.where(rows % 2, 0.2, 0.02))
    new = ~np.asarray(HALF) & (rows % 2 == 0)
    assert np.mean(np.abs(known[new] - 2.0)) < 0.3 * np.mean(np.abs(even[new] - 2.0))


def test_an_exact_frame_without_noise_stays_finite_and_where_it_is() -> None:
    np.testing.assert_allclose(depth_after(seen(2.0), wall(1e6), noise=0.0), 2.0, rtol=1e-5)


def test_what_is_another_surface_or_is_seen_flat_has_no_error() -> None:
    frame, everywhere = seen(2.2), jnp.ones(HEIGHT * WIDTH, bool)
    center = T.translation()
    error, is_known = depth_error(frame.points, wall(1.0), everywhere, center, config())
    assert bool(is_known.all())
    np.testing.assert_allclose(error, np.log(1.1), rtol=1e-4)
    error, is_known = depth_error(frame.points, wall(1.0), everywhere, center, config(max_error=0.05))
    assert not bool(is_known.any()) and not np.any(error)
    flat = wall(1.0, normal=(1.0, 0.0, 0.0))
    _, is_known = depth_error(frame.points, flat, everywhere, center, config(min_cos=0.5))
    assert not bool(is_known.any())


def test_window_is_gaussian_and_the_identity_without_width() -> None:
    np.testing.assert_array_equal(window(4, jnp.zeros(())), np.eye(4))
    np.testing.assert_allclose(window(4, jnp.asarray(2.0))[0], np.exp(-(np.arange(4) ** 2) / 8.0), rtol=1e-6)

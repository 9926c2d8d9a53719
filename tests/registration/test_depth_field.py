"""The smooth part of a frame's depth error is found, and split between the frame and the map."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene import device, matrix_of, on_host, pose

from emgs_jax.registration.depth_field import DepthField, depth_errors, depth_field, field_at, moved_by_field

HEIGHT, WIDTH, LENGTH = 30, 40, np.float32(0.3)
V, U = np.mgrid[:HEIGHT, :WIDTH]
RAYS = np.stack([(U - 19.5) / 40, (V - 14.5) / 40, np.ones_like(U)], axis=-1).reshape(-1, 3).astype(np.float32)
POINTS = 2.0 * RAYS
TRUE = 0.06 * RAYS[:, 0] / 0.5 - 0.04 * RAYS[:, 1] ** 2 / 0.36**2  # a slope and a bow, 5 % at the sides
estimated, value = on_host(depth_field), on_host(field_at)


def found(errors, noise=0.01, valid=True, points=POINTS, length=LENGTH) -> np.ndarray:
    """The field at every point."""
    rows = (np.broadcast_to(np.float32(values), len(RAYS)) for values in (errors, noise))
    field = estimated(points, *rows, np.broadcast_to(valid, len(RAYS)), length)
    return value(DepthField(*map(device, (field.nodes, field.low, field.high))), points)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def test_where_nothing_differs_and_nothing_may_there_is_no_field() -> None:
    """`icp.noise=0` with an exact prior: 0 / 0 was the field, and with it all points of a tracked frame."""
    assert not found(0.0, noise=0.0).any()


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_the_unit_of_length_is_nothing_to_it(unit: float) -> None:
    np.testing.assert_allclose(found(TRUE, points=unit * POINTS), found(TRUE), atol=1e-5)


def stated(errors, noise) -> np.ndarray:
    """The formula in float64, from five by five nodes over the image, errors of 160 points being independent."""
    plane = RAYS[:, :2].astype(float)
    place = 4 * (plane - plane.min(0)) / np.ptp(plane, axis=0)
    x, y = np.maximum(1 - np.abs(place[:, :, None] - np.arange(5)), 0).swapaxes(0, 1)
    B, nodes = np.einsum("pi,pj->pij", x, y).reshape(-1, 25), np.indices((5, 5)).reshape(2, -1).T / 4
    alike = np.exp(-0.5 * np.sum((nodes - nodes[:, None]) ** 2, -1) / float(LENGTH) ** 2)
    f = np.zeros(25)
    for _ in range(3):
        W = 1 / (noise**2 + (errors - B @ f) ** 2 / 4) / (len(RAYS) / 160)
        total, weighted = W @ B, B.T * W
        share = total / total.sum()
        variance = share @ (weighted @ errors / total) ** 2 - share @ (1 / total)
        K = max(variance, 0) * alike
        f = K @ np.linalg.solve(np.eye(25) + weighted @ B @ K, weighted @ errors)
    return B @ f


def test_the_field_is_that_of_the_formula_where_points_are_known_differently_well() -> None:
    rng = np.random.default_rng(1)
    noise = rng.uniform(0.005, 0.06, len(RAYS))
    errors = 0.5 * TRUE + noise * rng.normal(size=len(RAYS))
    expected = stated(errors, noise)
    assert 0.005 < rms(expected - 0.5 * TRUE) < 0.5 * rms(0.5 * TRUE)  # held back by what it is not clear of
    depths = rng.uniform(0.5, 2.0, (len(RAYS), 1)).astype(np.float32)  # which are nothing to it
    np.testing.assert_allclose(found(errors, noise, points=depths * RAYS), expected, atol=1e-4)


@pytest.mark.parametrize("valid", [False, np.arange(len(RAYS)) == 7])
def test_little_that_is_known_corrects_little(valid) -> None:
    assert np.abs(found(0.1, valid=valid)).max() <= 0.1
    if not np.any(valid):
        assert not found(0.1, valid=valid).any()


@pytest.mark.slow
def test_gradients_are_finite() -> None:
    def total(errors, points):
        return jnp.sum(
            depth_field(points, errors, jnp.full(len(RAYS), 0.01), jnp.ones(len(RAYS), bool), jnp.asarray(LENGTH)).nodes
        )

    for errors in (TRUE, np.zeros_like(TRUE)):
        assert all(np.isfinite(g).all() for g in jax.grad(total, (0, 1))(jnp.float32(errors), POINTS))


def test_what_is_moved_by_the_field_goes_along_its_ray() -> None:
    """The frame's points without their field, and half of it for the map: they meet half way."""
    T = pose((0.1, -0.2, 0.3), (1.0, 2.0, 3.0))
    field = jax.jit(depth_field)(POINTS, np.float32(TRUE), np.full(len(RAYS), 0.01, np.float32), TRUE == TRUE, LENGTH)
    turn, place = matrix_of(T)[:3, :3], matrix_of(T)[:3, 3]
    world = lambda points: (points @ turn.T + place).astype(np.float32)  # noqa: E731
    moved = jax.jit(moved_by_field)
    inner = (U % (WIDTH - 1) > 0) & (V % (HEIGHT - 1) > 0)  # not on the rim, which rounding may put beyond it
    points = POINTS[inner.ravel()]
    half = np.asarray(moved(world(points), field, np.float32(0.5), T))
    np.testing.assert_allclose(half, world(points * np.exp(0.5 * value(field, points))[:, None]), atol=1e-5)
    elsewhere = world(np.float32([[0, 0, -2], [3, 0, 2], [0, -9, 2]]))
    np.testing.assert_array_equal(moved(elsewhere, field, np.float32(1.0), T), elsewhere)
    nothing = DepthField(jnp.zeros_like(field.nodes), field.low, field.high)
    np.testing.assert_array_equal(moved(world(POINTS), nothing, np.float32(1.0), T), world(POINTS))


def test_errors_are_of_the_depth_along_the_ray_to_the_plane() -> None:
    normals = np.float32([[0, 0, -1], [0, 0, -1], [0, 0, -1], [1, 0, 0.05]])
    points, means = np.float32([[0, 0, 2.2], [0.5, 0, 2], [0, 0, -2], [0, 0, 2]]), np.float32([[1, 1, 2]] * 4)
    errors, is_known = on_host(depth_errors)(points, means, normals, np.zeros(3, np.float32), np.float32(0.3))
    np.testing.assert_array_equal(is_known, [True, True, False, False])  # behind the camera, along the plane
    np.testing.assert_allclose(errors, [np.log(1.1), 0, 0, 0], atol=1e-6)

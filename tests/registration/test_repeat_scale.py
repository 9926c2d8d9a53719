"""What the image that was predicted twice says of the scale, and how sure that is."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene import observe_room, path_pose

from emgs_jax.observation import Observation, transform
from emgs_jax.ops.camera import Camera
from emgs_jax.registration.repeat import repeat_scale

RATIO = jnp.asarray(1.0)
CAMERA = Camera([30.0, 33.0], [19.5, 15.25], 40, 32)


def scaled(observation: Observation, log_ratios: jax.Array) -> Observation:
    return eqx.tree_at(lambda o: o.points, observation, observation.points * jnp.exp(log_ratios)[..., None])


def scales_of(log_ratios: jax.Array) -> tuple[np.ndarray, np.ndarray]:
    """Of a prediction before that is larger by these, one row of pixels a draw."""
    T, now = path_pose(2), observe_room(path_pose(2), CAMERA)

    @eqx.filter_jit
    @eqx.filter_vmap
    def of(draw):
        return repeat_scale(now, transform(T, scaled(now, draw), jnp.ones(())), T, jnp.ones(()), RATIO)

    return tuple(np.asarray(value, float) for value in of(log_ratios))


def normal(*shape: int) -> jax.Array:
    return jax.random.normal(jax.random.key(0), shape)


def test_the_same_to_the_bit_is_certain():
    scale, std = scales_of(jnp.full((1, CAMERA.height * CAMERA.width), np.log(1.1)))
    assert scale[0] == pytest.approx(1.1, rel=1e-5) and std[0] < 1e-6


def test_the_deviation_is_that_of_the_scales_where_pixels_err_apart():
    log_ratios = 0.05 * normal(200, CAMERA.height * CAMERA.width)
    scale, std = scales_of(log_ratios)
    assert np.mean(std) == pytest.approx(np.std(np.log(scale)), rel=0.25)


def test_the_deviation_is_that_of_the_scales_where_regions_err_alike():
    """Eight by eight pixels share an error: the scale is worth as many measurements as there are such regions."""
    regions = 0.05 * normal(200, CAMERA.height // 8, CAMERA.width // 8)
    log_ratios = jnp.repeat(jnp.repeat(regions, 8, axis=1), 8, axis=2).reshape(200, -1)
    scale, std = scales_of(log_ratios)
    assert np.mean(std) == pytest.approx(np.std(np.log(scale)), rel=0.4)


def test_without_a_pair_the_other_scale_stands():
    T, now = path_pose(2), observe_room(path_pose(2), CAMERA)
    blind = eqx.tree_at(lambda o: o.valid, now, jnp.zeros_like(now.valid))
    scale, std = repeat_scale(now, transform(T, blind, jnp.ones(())), T, jnp.asarray(0.8), RATIO)
    assert scale == pytest.approx(0.8) and np.isfinite(std)

"""Derivatives in float32 are those of differences in float64, by each input alone: points, noise, pose, prior."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import scene as sc
from verbs import CAMERA, CONFIG, NOISE, ROWS, close, looking, map_of

from emgs_jax import em, surface_extrapolation
from emgs_jax.ops.pytree import take_rows
from emgs_jax.registration import icp, problem

pytestmark = pytest.mark.slow
STEP = 1e-6  # of float64, in m, rad and parts
SHARP = replace(
    CONFIG,
    localization=replace(CONFIG.localization, icp=replace(CONFIG.localization.icp, tolerance=1e-6, max_steps=64)),
)


def turned(T, xi):
    return T @ jaxlie.SE3.exp(xi)


def at(tree, **fields):
    names = list(fields)
    return eqx.tree_at(lambda t: [getattr(t, name) for name in names], tree, [fields[name] for name in names])


def fused(given, noise, points, means):
    observation, map, config = given
    map = eqx.tree_at(lambda m: m.gaussians.means, map, means)
    found = em.em_update(map, at(observation, points=points), noise, config.em)[0].gaussians
    return found.means, found.covs, found.colors


def registered(given, points, pose, prior, noise):
    observation, gaussians, start, T, config = given
    start = problem.CoarseStart(turned(T, pose), start * prior, noise, jnp.asarray(False))
    T, scale, info = icp.icp(at(observation, points=points), gaussians, start, config.localization.icp)
    return T.as_matrix(), scale, info.information


def continued(given, points, noise, pose, weight):
    observation, map, T, config = given
    map = at(take_rows(map, jnp.asarray(ROWS % 32)), weight=weight)
    extrapolation = config.extrapolation
    observation = at(observation, points=points)
    is_fused = jnp.asarray(ROWS % 3 > 0)
    T = turned(T, pose)
    moved = surface_extrapolation.extrapolate(observation, map, is_fused, noise, T, CAMERA, extrapolation)
    return (moved.points,)


def case(name):
    """The function, what is given, and what it is differentiated by."""
    nowhere = np.zeros(6, np.float32)
    observation, gaussians, map = close(0), sc.random_gaussians(32, 0, 2), map_of(0)
    if name == "em":
        config = sc.at(SHARP, "em.min_responsibility", 0.5)
        return fused, (observation, map, config), [NOISE[:32], observation.points, gaussians.means]
    if name == "icp":
        T, prior = sc.path_pose(0), 50.0 * np.eye(7, dtype=np.float32)
        seen = sc.moved_points(sc.pose_of(np.linalg.inv(sc.matrix_of(T))), observation)
        return registered, (seen, gaussians, prior, T, SHARP), [seen.points, nowhere, np.float32(1), np.float32(0.01)]
    wide = sc.random_observation(192, 0, 2)
    weight = np.linspace(1.0, 2.0, 192, dtype=np.float32)
    return continued, (wide, map, looking(0), SHARP), [wide.points, 0.1 * weight, nowhere, weight]


def in_float64(function, *arguments):
    """Its results where every float is one of float64."""
    wide = jax.tree.map(lambda x: np.float64(x) if np.asarray(x).dtype.kind == "f" else x, jax.device_get(arguments))
    bits = jax.lax.bitcast_convert_type
    with pytest.MonkeyPatch.context() as patch, jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        # By the bits of a float32 things are ordered, there too.
        patch.setattr(jax.lax, "bitcast_convert_type", lambda x, to: bits(jnp.float32(x), to))
        return jax.device_get(eqx.filter_jit(function)(*wide))


def directions_of(inputs):
    """For each input by itself a part of its largest entry."""
    rng, one_each = np.random.default_rng(0), []
    for place, given in enumerate(inputs):
        part = rng.uniform(-1, 1, given.shape) * max(np.abs(given).max(), 0.01)
        one_each.append([np.float32(part if i == place else np.zeros_like(x)) for i, x in enumerate(inputs)])
    return [np.stack(parts) for parts in zip(*one_each, strict=True)]


def slopes(function):
    def of(given, inputs, directions):
        return jax.vmap(lambda *d: jax.jvp(lambda *x: function(given, *x), inputs, d)[1])(*directions)

    return of


def differences(function):
    def of(given, inputs, directions):
        def along(*direction):
            ends = [
                function(given, *(x + sign * STEP * d for x, d in zip(inputs, direction, strict=True)))
                for sign in (1, -1)
            ]
            return jax.tree.map(lambda a, b: (a - b) / (2 * STEP), *ends)

        return jax.vmap(along)(*directions)

    return of


ICP = pytest.mark.xfail(
    strict=True, reason="residuals times derivatives of their Jacobian are left out, see `residuals`"
)


@pytest.mark.parametrize("name", ["em", pytest.param("icp", marks=[ICP, pytest.mark.weekly]), "extrapolation"])
def test_a_derivative_by_one_kind_of_input_is_that_of_float64_differences(name):
    """Forward, as the solver has a loop. The renderer's reverse mode is tested in render/test_composite.py."""
    function, given, inputs = case(name)
    inputs = tuple(jax.device_get(inputs))
    directions = directions_of(inputs)
    found = jax.device_get(eqx.filter_jit(slopes(function))(given, inputs, directions))
    exact = in_float64(differences(function), given, inputs, directions)
    for one, other in zip(found, exact, strict=True):
        assert np.isfinite(one).all()
        for a, b in zip(one, other, strict=True):
            wrong, size = (np.sqrt(np.mean(np.square(x))) for x in (a - b, b))
            assert wrong <= 1e-3 * size + 1e-9, (wrong, size)

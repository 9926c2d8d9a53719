"""Derivatives in float32 are those of differences in float64, by each kind of input alone: points, noise, pose, prior.

A row of which the two precisions choose another neighbour has other values; few do.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import scene as sc
from verbs import CAMERA, CONFIG, NOISE, ROWS, belief_of, close, looking, map_of, prediction_of, previous_of

from emgs_jax import em, slam, surface_extrapolation
from emgs_jax.ops import neighbours
from emgs_jax.ops.pytree import take_rows
from emgs_jax.registration import icp, problem
from emgs_jax.render import composite

pytestmark = pytest.mark.slow
STEP = 1e-6  # of float64, in m, rad and parts
SHARP = replace(CONFIG, localization=replace(CONFIG.localization, icp=replace(CONFIG.localization.icp, tolerance=1e-6)))


def turned(T, xi):
    return T @ jaxlie.SE3.exp(xi)


def at(tree, **fields):
    names = list(fields)
    return eqx.tree_at(lambda t: [getattr(t, name) for name in names], tree, [fields[name] for name in names])


def fused(given, noise, points, means):
    observation, map, config = given
    map = eqx.tree_at(lambda m: m.gaussians.means, map, means)
    return em.em_update(map, at(observation, points=points), noise, config.em)[0].gaussians


def registered(given, points, pose, prior, noise):
    observation, gaussians, start, T, config = given
    start = problem.CoarseStart(turned(T, pose), start * prior, noise, jnp.asarray(False))
    T, scale, info = icp.icp(at(observation, points=points), gaussians, start, config.localization.icp)
    return T.as_matrix(), scale, info.depth_noise


def continued(given, points, noise, pose, weight):
    observation, map, T, config = given
    map = at(take_rows(map, ROWS % 32), weight=weight)
    extrapolation = config.extrapolation
    observation = at(observation, points=points)
    is_fused = jnp.asarray(ROWS % 3 > 0)
    return surface_extrapolation.extrapolate(
        observation, map, is_fused, noise, turned(T, pose), CAMERA, extrapolation
    ).points


def drawn(given, means, covs, pose):
    gaussians, T, config = given
    render = config.refinement.render
    return composite.render(at(gaussians, means=means, covs=covs), gaussians.colors, turned(T, pose), CAMERA, render)


def stepped(given, points, pose, prior, covariance):
    """Poses of the prior, and the pose and uncertainty from which they go on."""
    state, prediction, config = given
    views = jax.vmap(turned)(prediction.T_world_views, prior)
    prediction = at(prediction, current=at(prediction.current, points=points), T_world_views=views)
    state = at(state, T_world_previous=turned(state.T_world_previous, pose))
    state = eqx.tree_at(lambda s: s.estimate.covariance, state, covariance)
    new, info = slam.step(state, prediction, CAMERA, config)
    return new.map.gaussians.means, new.map.gaussians.covs, info.T_world_camera.as_matrix()


def first_state():
    previous, T = previous_of(0), sc.path_pose(1)
    views = sc.stack([sc.observe_room(sc.path_pose(i), CAMERA, 2) for i in (0, 1)])
    first, _ = slam.init_state(views, sc.stack_poses([sc.path_pose(0), T]), CAMERA, SHARP)
    return at(first, previous=previous, T_world_previous=T, estimate=belief_of(0))


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
    if name == "extrapolation":
        wide = sc.random_observation(192, 0, 2)
        weight = np.linspace(1.0, 2.0, 192, dtype=np.float32)
        return continued, (wide, map, looking(0), SHARP), [wide.points, 0.1 * weight, nowhere, weight]
    if name == "render":
        return drawn, (gaussians, looking(0), SHARP), [gaussians.means, gaussians.covs, nowhere]
    state, prediction = first_state(), prediction_of(0)
    given = [prediction.current.points, nowhere, np.tile(nowhere, (3, 1)), state.estimate.covariance]
    return stepped, (state, prediction, SHARP), given


def in_float64(function, *arguments):
    """Its results where every float is one of float64."""
    wide = jax.tree.map(lambda x: np.float64(x) if np.asarray(x).dtype.kind == "f" else x, jax.device_get(arguments))
    with pytest.MonkeyPatch.context() as patch, jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        # The bits of a float32 rank it there.
        patch.setattr(neighbours, "ranks", lambda values: jnp.argsort(jnp.argsort(values, axis=-1), axis=-1))
        return jax.device_get(eqx.filter_jit(function)(*wide))


@pytest.mark.parametrize("name", ["em", "icp", "extrapolation", "render", "step"])
def test_a_derivative_by_one_kind_of_input_is_that_of_float64_differences(name):
    function, given, inputs = case(name)
    inputs = jax.device_get(inputs)
    rng = np.random.default_rng(0)
    one_each = []
    for place in range(len(inputs)):
        parts = [np.zeros_like(x) for x in inputs]
        size = max(np.abs(inputs[place]).max(), 0.01)
        parts[place] = np.asarray(rng.uniform(-1, 1, inputs[place].shape) * size, np.float32)
        if name == "render" and place == 1:
            parts[place] = parts[place] + parts[place].mT
        one_each.append(parts)
    directions = [np.stack(parts) for parts in zip(*one_each, strict=True)]

    def slopes(given, inputs, directions):
        call = lambda inputs: function(given, *inputs)  # noqa: E731
        return jax.vmap(lambda d: jax.jvp(call, (inputs,), (d,))[1])(directions)

    def differences(given, inputs, directions):
        def along(direction):
            ends = [
                function(given, *(x + sign * STEP * d for x, d in zip(inputs, direction, strict=True)))
                for sign in (1, -1)
            ]
            return jax.tree.map(lambda a, b: (a - b) / (2 * STEP), *ends)

        return jax.vmap(along)(directions)

    found = jax.device_get(eqx.filter_jit(slopes)(given, inputs, directions))
    exact = in_float64(differences, given, inputs, directions)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(exact), strict=True):
        if other.dtype.kind != "f":
            continue
        for i, (a, b) in enumerate(zip(one, other)):
            assert np.isfinite(a).all()
            scale = np.sqrt(np.mean(np.square(b)))
            err = np.abs(a - b)
            print(
                name,
                i,
                a.shape,
                "scale",
                scale,
                "max rel",
                err.max() / max(scale, 1e-12),
                "q99",
                np.quantile(err, 0.99) / max(scale, 1e-12),
                "rms",
                np.sqrt(np.mean(err**2)) / max(scale, 1e-12),
            )

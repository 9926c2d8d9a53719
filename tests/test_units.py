"""Nothing depends on the unit of length: in a world 1024 times as small or large the same comes out, scaled.

The factors are powers of two, so that floats are scaled without rounding: what differs is a length in the code. Lengths
of the config scale with the world. All of them together are in test_worlds.py.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import scene as sc
from verbs import CAMERA, CONFIG, DENSIFY, ROWS, graph_of, map_of

from emgs_jax import em, existence, gaussians, splitting, surface_extrapolation
from emgs_jax.initialization import initialize
from emgs_jax.ops.pytree import take_rows
from emgs_jax.pose_graph import deform
from emgs_jax.pose_graph.optimize import PoseGraphConfig, optimize
from emgs_jax.refinement import refine
from emgs_jax.render import densify

pytestmark = pytest.mark.slow
VIEW = sc.path_pose(2)
ORDERS = {"means": 1, "covs": 2, "points": 1, "depth": 1, "depth_std": 1, "gradients": -1}  # powers of a length


def pose(T, s):
    return jaxlie.SE3(sc.device(np.asarray(T.wxyz_xyz) * ([1.0] * 4 + [s] * 3)))


def lengths(tree, s):
    """The tree in the other unit: its fields named as in `ORDERS`, and poses."""

    def of(path, leaf):
        name = str(path[-1]).strip(".[']") if path else ""
        if isinstance(leaf, jaxlie.SE3):
            return pose(leaf, s)
        return leaf * np.float32(s ** ORDERS[name]) if name in ORDERS else leaf

    return jax.tree_util.tree_map_with_path(of, tree, is_leaf=lambda x: isinstance(x, jaxlie.SE3))


def config(s):
    return CONFIG.in_unit(s)


def seen(seed):
    """A view of the room from the path, placed in the world."""
    T = sc.path_pose(seed)
    return sc.moved_points(T, sc.observe_room(T, CAMERA, 2))


@sc.on_host
def fuse(map, aligned, noise, config):
    updated, step, _ = em.em_update(map, aligned, noise, config.em)
    first, second = splitting.split(updated, aligned, noise, em.owners(step, 32), 1, config.splitting)
    return first, second.gaussians, step.is_fused


@sc.on_host
def look(map, view, T, config):
    frame = existence.Look(view, T, CAMERA, jnp.float32(0.02), jaxlie.SE3.identity())
    updated, is_seen = existence.update_existence(map, jnp.arange(32) % 3 - 1, frame, config.existence)
    merged = existence.merge_duplicates(updated, is_seen, T.translation(), jnp.float32(0.1), config.existence)
    taken = merged.gaussians.valid[:, None, None]
    return eqx.tree_at(lambda m: m.gaussians.covs, merged, merged.gaussians.covs * taken), is_seen


refined = sc.on_host(lambda m, g, T, config: refine(m, g, T, CAMERA, config.refinement)[:2])
densified = sc.on_host(lambda g, T, config: densify.densify(g, T, CAMERA, config))
moved = sc.on_host(lambda m, a, b, std: deform.deform(m, a, b, std, deform.DeformConfig(4, 40.0)))
started = sc.on_host(lambda views, T, config: initialize(views, T, CAMERA, 1, config.fit)[0])
slopes = sc.on_host(lambda g: gaussians.color_gradients(g, 6))
continued = sc.on_host(
    lambda o, m, rows, T, config: surface_extrapolation.extrapolate(
        o, take_rows(m, rows % 32), rows % 3 > 0, o.confidence, T, CAMERA, config.extrapolation
    )
)


def initialization(s):
    views = sc.stack([lengths(sc.observe_room(sc.path_pose(i), CAMERA, 2), s) for i in (0, 1)])
    return started(views, pose(sc.stack_poses([sc.path_pose(0), sc.path_pose(1)]), s), config(s))


def colour_gradients(s):
    return {"gradients": slopes(lengths(sc.random_gaussians(32, 0, 2), s))}


def fusion(s):
    g = sc.random_gaussians(32, 0, 2)
    points = sc.replace(sc.random_observation(32, 0, 2), points=np.asarray(g.means) + 0.01)
    return fuse(lengths(map_of(0), s), lengths(points, s), np.full((32, 3), 0.02 * s, np.float32), config(s))


def refinement(s):
    return refined(*(lengths(x, s) for x in (map_of(0), sc.random_gaussians(9, 5, 2))), pose(VIEW, s), config(s))


def looks(s):
    return look(lengths(map_of(0), s), lengths(seen(2), s), pose(VIEW, s), config(s))


def extrapolation(s):
    return continued(lengths(seen(2), s), lengths(map_of(0), s), ROWS, pose(VIEW, s), config(s))


def densification(s):
    return densified(lengths(sc.random_gaussians(32, 0, 2), s), pose(sc.pose(), s), sc.at(DENSIFY, "min_std", 0.05 * s))


def deformation(s):
    nodes = [lengths(graph_of(seed).nodes, s) for seed in (0, 5)]
    return moved(lengths(map_of(0), s), *nodes, np.float32(0.01 * s))


def pose_graph(s):
    """A length's information is one over its square."""
    graph = graph_of(0)
    units = np.float32([1.0 / s] * 3 + [1.0] * 4)
    graph = eqx.tree_at(lambda g: g.factors.sqrt_info, lengths(graph, s), graph.factors.sqrt_info * units)
    nodes, info = optimize(graph, PoseGraphConfig(0.5, 10.0, "chordal", 30, 1e-4, 1e-6, np.inf))
    return nodes, np.float32([info.cost, info.num_iterations])


STAGES = initialization, colour_gradients, fusion, refinement, looks, extrapolation, densification
STAGES += deformation, pose_graph


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.__name__)
@pytest.mark.parametrize("s", [2.0**-10, 2.0**10])
def test_a_stage_is_the_same_in_every_unit(stage, s):
    """Counts and choices exactly; numbers to the rounding of sums in which a length is added to none."""
    expected, found = stage(1.0), lengths(stage(s), 1.0 / s)
    for one, other in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
        if np.asarray(one).dtype.kind == "f":
            unit = np.abs(np.where(np.isfinite(one), one, 0.0)).max(initial=1e-6)
            np.testing.assert_allclose(other, one, atol=1e-4 * unit)
        else:
            np.testing.assert_array_equal(other, one)

"""Public functions of the core with arguments of small fixed shapes, for tests of what JAX makes of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scene as sc

from emgs_jax import (
    em,
    existence,
    gaussian_map,
    gaussians,
    initialization,
    layers,
    localization,
    motion,
    semantics,
    splitting,
    surface_extrapolation,
)
from emgs_jax import observation as obs
from emgs_jax.ops import camera as cam
from emgs_jax.ops import clustering, linalg, neighbours
from emgs_jax.ops.pytree import take_rows
from emgs_jax.pose_graph import deform, factors
from emgs_jax.refinement import refine
from emgs_jax.registration import icp, noise, pose_estimate, pose_noise, problem, rigid
from emgs_jax.render import composite, densify, project
from emgs_jax.slam import as_seen

CAMERA = cam.Camera([10.0, 11.5], [7.5, 5.25], 16, 12)
CONFIG = sc.slam_config("slam.submap.map_capacity=48", "slam.submap.submap_capacity=32", "render.tile_capacity=32")
DENSIFY = densify.DensifyConfig(min_std=0.0, render=CONFIG.refinement.render, points="map")
ONE = sc.device(1.0)
ROWS = np.arange(192)
MOTION = sc.slam_config("slam.motion.num_looks=3").motion


def map_of(seed: int) -> gaussian_map.GaussianMap:
    return sc.fresh_map(sc.random_gaussians(32, seed, 2))


def prediction_of(seed: int) -> obs.Prediction:
    """Poses some millimetres off, likewise."""
    given, rng = sc.predict_room(2 + seed, CAMERA, num_features=2), np.random.default_rng(seed)
    views = sc.device(np.asarray(given.T_world_views.wxyz_xyz) + 0.005 * rng.normal(size=(3, 7)))
    return eqx.tree_at(lambda p: p.T_world_views.wxyz_xyz, given, views)


def previous_of(seed: int) -> obs.Observation:
    """Some millimetres off, as predictions are: at a pair that fits exactly the distance has no gradient."""
    T = sc.path_pose(1 + seed)
    world = sc.moved_points(T, sc.observe_room(T, CAMERA, 2))
    return sc.replace(world, points=world.points + 0.005 * np.random.default_rng(seed).normal(size=world.points.shape))


def image_of(seed: int):
    """A slanted plane, so that every window determines its normal."""
    x, y = (np.arange(16) - 7.5) / 10.0, (np.arange(12) - 5.25) / 11.5
    rays = np.stack(np.broadcast_arrays(x, y[:, None], 1.0), axis=-1)
    plane = rays / (1.0 - (0.02 + 0.01 * seed) * rays[..., :1])
    arrays = (
        plane,
        0.3 + 0.1 * np.abs(plane),
        np.full((12, 16, 2), 0.5**0.5),
        np.full((12, 16), 1.5),
        np.ones((12, 16), bool),
    )
    return tuple(map(sc.device, arrays))


def belief_of(seed: int) -> pose_estimate.PoseEstimate:
    covariance = sc.device(np.diag([4e-4] * 3 + [1e-4] * 4) * (1.0 + seed))
    numbers, no = map(sc.device, (0.01, 0.02, 3.0)), jnp.asarray(False)
    return pose_estimate.PoseEstimate(covariance, *numbers, pose_noise.no_repeats(), no)


def coarse_of(seed: int) -> localization.CoarsePose:
    T, numbers = sc.path_pose(2 + seed), map(sc.device, (1.0, 0.02, 2.0, 0.01))
    return localization.CoarsePose(T, T, *numbers, belief_of(seed), *[jnp.asarray(True)] * 4)


def looks_of(seed: int) -> motion.Looks:
    """Two frames of the room, of which some rows were taken for moving."""
    looks = motion.no_looks(previous_of(seed), MOTION)
    for number in (0, 1):
        T, moving = sc.path_pose(number + seed), jnp.asarray((ROWS - number) % 7 == 0)
        view, time = previous_of(seed + number), jnp.asarray(number, jnp.int32)
        looks = motion.look_back(looks, view, moving, T, sc.path_pose(seed), belief_of(seed), CAMERA, MOTION)
        looks = motion.look_again(looks, view, moving, T, time, CAMERA)
    # As after more frames: what is 0 is at a gate.
    return sc.replace(looks, free=looks.free + 0.5, step=looks.step + 0.2)


def estep_of(seed: int) -> em.EStep:
    rng = np.random.default_rng(seed)
    rows, shares = rng.integers(0, 32, (40, 3)).astype(np.int32), rng.dirichlet(np.ones(3), 40)
    return sc.explained(rows, shares, np.ones(40, bool))


def points(seed: int):
    return sc.random_observation(40, seed, 2)


def close(seed: int):
    """Points on the map, so that EM fuses them."""
    g = sc.random_gaussians(32, seed, 2)
    return obs.Observation(
        sc.device(np.asarray(g.means) + 0.01), g.colors, g.normals, g.features, sc.device(np.ones(32)), g.valid
    )


def looking(seed: int):
    return sc.pose(translation=(0.1 * seed, 0, 0))


def graph_of(seed: int) -> factors.PoseGraph:
    """Poses that are some centimetres off what the edges say; one edge is not in use."""
    rng = np.random.default_rng(seed)
    a, b = np.arange(6, dtype=np.int32) % 5, (np.arange(6, dtype=np.int32) + 2) % 5
    T = [sc.pose(rng.normal(size=3), rng.normal(size=3)) for _ in range(5)]
    off = [sc.pose(0.05 * rng.normal(size=3), 0.05 * rng.normal(size=3)) for _ in range(6)]
    between = [
        np.linalg.inv(sc.matrix_of(T[i])) @ sc.matrix_of(T[j]) @ sc.matrix_of(d)
        for i, j, d in zip(a, b, off, strict=True)
    ]
    nodes = factors.Nodes(sc.stack_poses(T), sc.device(0.1 * rng.normal(size=5)), sc.device(np.ones(5, bool)))
    said = (
        sc.stack_poses([sc.pose_of(one) for one in between]),
        *map(sc.device, (rng.normal(size=6), rng.normal(size=(6, 7, 7)))),
    )
    return factors.PoseGraph(
        nodes, factors.Factors(*map(sc.device, (a, b)), *said, sc.device(a % 2 == 1), sc.device(np.arange(6) < 5))
    )


NOISE = np.full((40, 3), 0.02, np.float32)
MASK, ORDER = np.arange(40) % 3 > 0, np.arange(40)
# name: (verb of one item, its arguments by seed)
VERBS = {
    "safe_normalize": (linalg.safe_normalize, lambda s: (points(s).points,)),
    "whitening": (linalg.whitening, lambda s: (sc.random_gaussians(9, s).covs,)),
    "tangent_basis": (linalg.tangent_basis, lambda s: (points(s).normals,)),
    "principal_axes": (linalg.principal_axes_2x2, lambda s: (np.asarray(sc.random_gaussians(9, s).covs)[:, :2, :2],)),
    "project": (lambda p: cam.project(CAMERA, p), lambda s: (points(s).points,)),
    "unproject": (lambda d: cam.unproject(CAMERA, d), lambda s: (sc.device(np.full((12, 16), 1.0 + s)),)),
    "observe": (lambda *x: obs.observe(*x, CONFIG.observation), image_of),
    "transform": (obs.transform, lambda s: (sc.path_pose(s), points(s), sc.device(1.1))),
    "knn": (
        lambda q, p: neighbours.knn(q, p, jnp.asarray(MASK), 3),
        lambda s: (points(s + 5).points, points(s).points),
    ),
    "compact_rows": (lambda m: neighbours.compact_rows(m, 20), lambda s: (np.roll(MASK, s),)),
    "strided_seeds": (lambda m: clustering.strided_seeds(m, jnp.asarray(ORDER), 4, 10), lambda s: (np.roll(MASK, s),)),
    "kmeans": (
        lambda p, c: clustering.kmeans(p, jnp.asarray(MASK), c, jnp.asarray(MASK[:8]), 2),
        lambda s: (points(s).points, np.asarray(points(s).points)[:8]),
    ),
    "fit_to_points": (
        lambda c, o: gaussians.fit_to_points(c, jnp.ones(6, bool), o, CONFIG.fit),
        lambda s: (sc.device(np.asarray(points(s).points)[:6] + 0.01), points(s)),
    ),
    "cluster": (lambda o: gaussians.cluster(o, jnp.asarray(ORDER), 8, CONFIG.fit), lambda s: (points(s),)),
    "blend": (
        gaussians.blend,
        lambda s: (sc.random_gaussians(9, s), sc.random_gaussians(9, s + 5), sc.device(np.full(9, 0.3)), ONE),
    ),
    "update_average": (
        lambda m, g, e: gaussian_map.update_average(m, g, e, CONFIG.em.average),
        lambda s: (map_of(s), sc.random_gaussians(32, s + 5, 2), sc.device(np.linspace(0.1, 1.0, 32))),
    ),
    "select_submap": (
        lambda m, o: gaussian_map.select_submap(m, (o,), CONFIG.submap),
        lambda s: (map_of(s), points(s)),
    ),
    "insert": (
        lambda m, g: gaussian_map.insert(m, gaussian_map.new_map(g, jnp.ones(9), ONE, jnp.asarray(0))),
        lambda s: (map_of(s), sc.random_gaussians(9, s, 2)),
    ),
    "fit_rigid": (rigid.fit_rigid, lambda s: (points(s).points, points(s + 5).points, sc.device(np.ones(40)))),
    "predict": (
        lambda b, T: pose_estimate.propagate_covariance(b.covariance, T, 1e-4 * jnp.eye(7)),
        lambda s: (belief_of(s), sc.path_pose(s)),
    ),
    "update": (
        lambda b: pose_estimate.kalman_update(b.covariance, jnp.linspace(0.0, 0.1, 7), 1e3 * jnp.eye(7)),
        lambda s: (belief_of(s),),
    ),
    "icp": (
        lambda o, g, T: icp.icp(
            o,
            g,
            problem.CoarseStart(T, jnp.diag(50.0 * jnp.ones(7)), ONE * 0.01, jnp.asarray(False)),
            CONFIG.localization.icp,
        ),
        lambda s: (
            sc.moved_points(sc.pose_of(np.linalg.inv(sc.matrix_of(sc.path_pose(s)))), close(s)),
            sc.random_gaussians(32, s, 2),
            sc.path_pose(s),
        ),
    ),
    "initialize": (
        lambda v, T: initialization.initialize(v, T, CAMERA, 1, CONFIG.fit),
        lambda s: (
            sc.stack([sc.observe_room(sc.path_pose(i + s), CAMERA, 2) for i in (0, 1)]),
            sc.stack_poses([sc.path_pose(s), sc.path_pose(1 + s)]),
        ),
    ),
    "localize_coarse": (
        lambda p, o, T: localization.localize_coarse(p, o, T, CAMERA, CONFIG.localization),
        lambda s: (prediction_of(s), previous_of(s), sc.path_pose(1 + s)),
    ),
    "localize_fine": (
        lambda o, g, c: localization.localize_fine(o, g, c, CONFIG.localization),
        lambda s: (sc.observe_room(sc.path_pose(2 + s), CAMERA, 2), sc.random_gaussians(32, s, 2), coarse_of(s)),
    ),
    "m_step": (
        lambda g, o, e: em.m_step(g, o, jnp.ones(40), e, CONFIG.em),
        lambda s: (sc.random_gaussians(32, s, 2), points(s), estep_of(s)),
    ),
    "em_update": (
        lambda m, o: em.em_update(m, o, jnp.asarray(NOISE[:32]), sc.at(CONFIG.em, "min_responsibility", 0.5)),
        lambda s: (map_of(s), close(s)),
    ),
    "split": (
        lambda m, o, e: splitting.split(m, o, jnp.asarray(NOISE), em.owners(e, 32), 1, CONFIG.splitting),
        lambda s: (map_of(s), points(s), estep_of(s)),
    ),
    "project_gaussians": (
        lambda g, T: project.project_gaussians(g, T, CAMERA, ONE, ONE),
        lambda s: (sc.random_gaussians(32, s, 2), looking(s)),
    ),
    "render": (
        lambda g, T: composite.render(g, g.colors, T, CAMERA, CONFIG.refinement.render),
        lambda s: (sc.random_gaussians(32, s, 2), looking(s)),
    ),
    "densify": (
        lambda g, T: densify.densify(g, T, CAMERA, DENSIFY),
        lambda s: (sc.random_gaussians(32, s, 2), looking(s)),
    ),
    "extrapolate": (
        lambda m, o, T: surface_extrapolation.extrapolate(
            o,
            take_rows(m, jnp.asarray(ROWS % 32)),
            jnp.asarray(ROWS % 3 > 0),
            o.confidence,
            T,
            CAMERA,
            CONFIG.extrapolation,
        ),
        lambda s: (map_of(s), sc.random_observation(192, s, 2), looking(s)),
    ),
    "update_existence": (
        lambda m, o, T: existence.update_existence(
            m, jnp.arange(32) % 3 - 1, existence.Look(o, T, CAMERA, ONE * 0.02, T), CONFIG.existence
        ),
        lambda s: (map_of(s), sc.random_observation(192, s, 2), looking(s)),
    ),
    "merge_duplicates": (
        lambda m, T: existence.merge_duplicates(
            m, jnp.arange(32) % 3 > 0, T.translation(), ONE * 0.1, CONFIG.existence
        ),
        lambda s: (map_of(s), looking(s)),
    ),
    "one_layer": (
        lambda m, o: layers.one_layer(m, jnp.arange(32) % 2 > 0, o, ONE * 0.1, CONFIG.existence),
        lambda s: (map_of(s), map_of(s + 9).gaussians.means),
    ),
    "look_again": (
        lambda k, o, T: motion.look_again(k, o, jnp.asarray(ROWS % 5 == 0), T, jnp.asarray(4, jnp.int32), CAMERA),
        lambda s: (looks_of(s), previous_of(s), sc.path_pose(1 + s)),
    ),
    "look_back": (
        lambda k, o, T, b: motion.look_back(k, o, jnp.asarray(ROWS % 5 == 0), T, sc.path_pose(1), b, CAMERA, MOTION),
        lambda s: (looks_of(s), previous_of(s), sc.path_pose(1 + s), belief_of(s)),
    ),
    "take_back": (
        lambda m, k, T: existence.take_back(
            m, as_seen(jax.tree.map(lambda leaf: leaf[1], k), T, ONE * 0.02), CAMERA, CONFIG.existence
        ),
        lambda s: (map_of(s), looks_of(s), looking(s)),
    ),
    "find_movers": (
        lambda k, o, T, b: motion.find_movers(k, o, T, b, CAMERA, MOTION),
        lambda s: (looks_of(s), sc.observe_room(sc.path_pose(2 + s), CAMERA, 2), looking(s), belief_of(s)),
    ),
    "num_independent": (
        lambda e, p: noise.num_independent(e, p, jnp.arange(40) % 3 > 0),
        lambda s: (points(s).colors[:, 0], points(s).points),
    ),
    "move": (factors.move, lambda s: (graph_of(s).nodes, sc.device(np.full((5, 7), 0.1)))),
    "deform": (
        lambda m, before, after: deform.deform(m, before, after, ONE * 0.01, deform.DeformConfig(4, 40.0)),
        lambda s: (map_of(s), graph_of(s).nodes, graph_of(s + 5).nodes),
    ),
    "residuals": (factors.residuals, lambda s: (graph_of(s),)),
    "linearize": (factors.linearize, lambda s: (graph_of(s),)),
    "robust": (
        lambda chi2, kernel: factors.robust(chi2, jnp.arange(6) % 2 == 1, kernel),
        lambda s: (sc.device(np.linspace(0.0, 60.0 + s, 6)), sc.device(16.8)),
    ),
    "classify": (semantics.classify, lambda s: (sc.random_gaussians(9, s, 2), sc.device(np.eye(2)))),
    "relevance": (
        lambda g, words: semantics.relevance(g, words, words[:1] + 0.1, ONE * 0.01, -ONE),
        lambda s: (sc.random_gaussians(32, s, 2), sc.device([[1.0, 0.2], [0.1, -1.0 - s]])),
    ),
    "refine": (
        lambda m, g, T: refine(m, g, T, CAMERA, CONFIG.refinement),
        lambda s: (map_of(s), sc.random_gaussians(9, s + 5, 2), looking(s)),
    ),
}
# These end where a solver or a gate decides, or sum many terms.
LOOSE = {"render", "icp", "localize_coarse", "localize_fine", "refine", "densify", "initialize"}
# The solver has a while loop, which has no reverse mode; to compile it with a derivative takes half a minute.
FORWARD = {"icp", "localize_fine"}
# Medians: where rows move apart, another one takes the median's place at once.
ROWS_TOGETHER = {"localize_coarse", "localize_fine"}
# Each is the larger part of another verb, which is compiled in its place.
INSIDE_ANOTHER = {"icp", "m_step", "fit_to_points", "cluster", "kmeans", "render", "project_gaussians"}
INSIDE_ANOTHER |= {"residuals", "knn"}

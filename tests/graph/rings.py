"""Graphs whose truth is known: rings that are walked several times, measured with or without noise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.graph.measurements import LOOP, ODOMETRY, Edges, Graph, Nodes, move
from emgs_jax.graph.optimize import GraphConfig

OFFSETS = (1, 2, 3, 5, 8)
STD = np.array([0.01, 0.01, 0.01, 0.005, 0.005, 0.005, 0.01])  # m, rad, log


def config(**changes) -> GraphConfig:
    values = {"scale_std": 0.0, "kernel": 16.8, "start": "spread", "max_iterations": 30, "damping": 1e-6}
    return GraphConfig(**(values | {"min_decrease": 1e-8, "max_misfit": np.inf} | changes))


def walk(num_nodes: int, laps: float = 2.0, radius: float = 4.0, scale_std: float = 0.0, seed: int = 0) -> Nodes:
    """True poses on a ring that rises and tilts a little, looking along the path."""
    angle = 2 * np.pi * laps * np.arange(num_nodes) / num_nodes
    centers = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.2 * np.sin(3 * angle)], -1)
    turns = jaxlie.SO3.from_z_radians(jnp.asarray(angle)) @ jaxlie.SO3.from_x_radians(jnp.asarray(0.1 * np.sin(angle)))
    scales = scale_std * np.random.default_rng(seed).normal(size=num_nodes)
    scales[0] = 0.0
    T = jaxlie.SE3.from_rotation_and_translation(turns, jnp.asarray(centers))
    return Nodes(T, jnp.asarray(scales), jnp.ones(num_nodes, bool))


def measure(nodes: Nodes, pairs, kind=ODOMETRY, std=STD, rng=None) -> Edges:
    """Edges of pairs (e, 2), exact without `rng`; the information is that of `std`."""
    a, b = np.asarray(pairs).T
    count = len(a)
    T, scale = nodes.T_world, np.asarray(nodes.log_scale)
    Z = jaxlie.SE3(T.wxyz_xyz[a]).inverse() @ jaxlie.SE3(T.wxyz_xyz[b])
    shrunk = jnp.exp(-scale[a])[:, None] * Z.translation()
    Z = jaxlie.SE3.from_rotation_and_translation(Z.rotation(), shrunk)
    noise = np.zeros((count, 7)) if rng is None else rng.normal(size=(count, 7)) * std
    Z = Z @ jaxlie.SE3.exp(jnp.asarray(noise[:, :6]))
    roots = jnp.broadcast_to(jnp.diag(1.0 / jnp.asarray(std)), (count, 7, 7))
    ratio = jnp.asarray(scale[b] - scale[a] + noise[:, 6])
    kinds = jnp.full(count, kind, jnp.int32)
    return Edges(*(jnp.asarray(x, jnp.int32) for x in (a, b)), Z, ratio, roots, kinds, jnp.ones(count, bool))


def join(*edges: Edges) -> Edges:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *edges)


def window_pairs(num_nodes: int, offsets=OFFSETS):
    return [(i, i + offset) for offset in offsets for i in range(num_nodes - offset)]


def loop_pairs(num_nodes: int, count: int, laps: int = 2):
    lap = num_nodes // laps
    return [(i, i + lap) for i in np.linspace(0, lap - 1, count).astype(int)]


def disturb(nodes: Nodes, rng, std) -> Nodes:
    steps = rng.normal(size=(nodes.valid.shape[0], 7)) * std
    steps[0] = 0.0
    return move(nodes, jnp.asarray(steps))


def chain(nodes: Nodes, edges: Edges) -> Nodes:
    """Poses by the measurements between neighbours, which come first, from the first pose on; scales 1."""
    poses = [jaxlie.SE3(nodes.T_world.wxyz_xyz[0])]
    for row in range(nodes.valid.shape[0] - 1):
        poses.append(poses[-1] @ jaxlie.SE3(edges.Z_a_b.wxyz_xyz[row]))
    return Nodes(jaxlie.SE3(jnp.stack([T.wxyz_xyz for T in poses])), 0 * nodes.log_scale, nodes.valid)


def noisy_laps(num_nodes: int, num_loops: int, seed: int, std=STD) -> tuple[Nodes, Graph]:
    """Truth, and the graph of two laps as it stands before a closure: the chain of its odometry. SE(3)."""
    rng, truth = np.random.default_rng(seed), walk(num_nodes)
    edges = measure(truth, window_pairs(num_nodes), ODOMETRY, std, rng)
    loops = measure(truth, loop_pairs(num_nodes, num_loops), LOOP, std, rng)
    edges = without_scale(join(edges, loops))
    return truth, Graph(chain(truth, edges), edges)


def without_scale(edges: Edges) -> Edges:
    return eqx.tree_at(lambda e: e.sqrt_info, edges, edges.sqrt_info.at[:, 6].set(0.0))


def error(nodes: Nodes, truth: Nodes) -> np.ndarray:
    """(n, 7) steps from the nodes to the truth."""
    steps = (nodes.T_world.inverse() @ truth.T_world).log()
    return np.concatenate([steps, np.asarray(truth.log_scale - nodes.log_scale)[:, None]], axis=1)


def rmse(nodes: Nodes, truth: Nodes) -> float:
    """m, in the frame of the first pose."""
    difference = np.asarray(nodes.T_world.translation() - truth.T_world.translation())
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=-1))))

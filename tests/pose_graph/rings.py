"""Graphs whose truth is known: rings that are walked several times, measured with or without noise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.pose_graph.factors import Factors, Nodes, PoseGraph
from emgs_jax.pose_graph.optimize import PoseGraphConfig

OFFSETS = (1, 2, 3, 5, 8)
STD = np.array([0.01, 0.01, 0.01, 0.005, 0.005, 0.005, 0.01])  # m, rad, log


def config(**changes) -> PoseGraphConfig:
    values = {"scale_std": 0.0, "kernel": 16.8, "start": "chordal", "max_iterations": 30, "damping": 1e-6}
    return PoseGraphConfig(**(values | {"min_decrease": 1e-8, "max_misfit": np.inf} | changes))


# Rigid motions as matrices (..., 4, 4), in NumPy: every operation of JAX is compiled anew for every number of nodes.


def motions(rotations: Rotation, translations) -> np.ndarray:
    matrices = np.tile(np.eye(4), (len(translations), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = rotations.as_matrix(), translations
    return matrices


def _left_jacobian(omega: np.ndarray) -> np.ndarray:
    angle, skew = np.linalg.norm(omega, axis=-1)[:, None, None], np.cross(np.eye(3), omega[:, None])
    safe = np.where(angle > 1e-6, angle, 1.0)
    first = np.where(angle > 1e-6, (1 - np.cos(safe)) / safe**2, 0.5)
    second = np.where(angle > 1e-6, (safe - np.sin(safe)) / safe**3, 1 / 6)
    return np.eye(3) + first * skew + second * skew @ skew


def exp(xi) -> np.ndarray:
    """Of steps (n, 6), translation first."""
    xi = np.atleast_2d(np.asarray(xi, float))
    return motions(Rotation.from_rotvec(xi[:, 3:]), np.einsum("nij,nj->ni", _left_jacobian(xi[:, 3:]), xi[:, :3]))


def log(matrices: np.ndarray) -> np.ndarray:
    """(n, 6)."""
    omega = Rotation.from_matrix(matrices[:, :3, :3]).as_rotvec()
    return np.concatenate([np.linalg.solve(_left_jacobian(omega), matrices[:, :3, 3:])[..., 0], omega], axis=1)


def matrices_of(T: jaxlie.SE3) -> np.ndarray:
    values = np.asarray(T.wxyz_xyz, float)
    return motions(Rotation.from_quat(np.roll(values[:, :4], -1, axis=1)), values[:, 4:])


def poses_of(matrices: np.ndarray) -> jaxlie.SE3:
    quaternions = np.roll(Rotation.from_matrix(matrices[:, :3, :3]).as_quat(canonical=True), 1, axis=1)
    return jaxlie.SE3(jnp.asarray(np.concatenate([quaternions, matrices[:, :3, 3]], axis=1)))


def put(tree, **leaves):
    """With these leaves, as they are or by a function of what they were."""

    def new(name, value):
        if isinstance(value, jaxlie.SE3):
            return value
        return jnp.asarray(value(np.array(getattr(tree, name))) if callable(value) else np.asarray(value))

    values = tuple(new(name, value) for name, value in leaves.items())
    return eqx.tree_at(lambda x: tuple(getattr(x, name) for name in leaves), tree, values)


def rows_of(tree, rows):
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[rows]), tree)


def walk(num_nodes: int, laps: float = 2.0, radius: float = 4.0, scale_std: float = 0.0, seed: int = 0) -> Nodes:
    """True poses on a ring that rises and tilts a little, looking along the path."""
    angle = 2 * np.pi * laps * np.arange(num_nodes) / num_nodes
    centers = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.2 * np.sin(3 * angle)], -1)
    turns = Rotation.from_euler("z", angle[:, None]) * Rotation.from_euler("x", 0.1 * np.sin(angle)[:, None])
    scales = scale_std * np.random.default_rng(seed).normal(size=num_nodes)
    scales[0] = 0.0
    return Nodes(poses_of(motions(turns, centers)), jnp.asarray(scales), jnp.asarray(np.ones(num_nodes, bool)))


def measure(nodes: Nodes, pairs, std=STD, rng=None, is_loop=False) -> Factors:
    """Edges of pairs (e, 2), exact without `rng`; the information is that of `std`."""
    a, b = np.asarray(pairs).T
    count = len(a)
    T, scale = matrices_of(nodes.T_world), np.asarray(nodes.log_scale)
    Z = np.linalg.inv(T[a]) @ T[b]
    Z[:, :3, 3] *= np.exp(-scale[a])[:, None]
    noise = np.zeros((count, 7)) if rng is None else rng.normal(size=(count, 7)) * std
    roots = np.tile(np.diag(1.0 / np.asarray(std)), (count, 1, 1))
    arrays = scale[b] - scale[a] + noise[:, 6], roots, np.full(count, is_loop), np.ones(count, bool)
    ends = (jnp.asarray(x.astype(np.int32)) for x in (a, b))
    return Factors(*ends, poses_of(Z @ exp(noise[:, :6])), *map(jnp.asarray, arrays))


def measure_loops(nodes: Nodes, pairs, std=STD, rng=None) -> Factors:
    """The same, as loop factors."""
    return measure(nodes, pairs, std, rng, is_loop=True)


def join(*edges):
    """All edges, or all nodes."""
    return jax.tree.map(lambda *leaves: jnp.asarray(np.concatenate(leaves)), *edges)


def window_pairs(num_nodes: int, offsets=OFFSETS):
    return [(i, i + offset) for offset in offsets for i in range(num_nodes - offset)]


def loop_pairs(num_nodes: int, count: int, laps: int = 2):
    lap = num_nodes // laps
    return [(i, i + lap) for i in np.linspace(0, lap - 1, count).astype(int)]


def disturb(nodes: Nodes, rng, std) -> Nodes:
    steps = rng.normal(size=(nodes.valid.shape[0], 7)) * std
    steps[0] = 0.0
    return stepped(nodes, steps)


def stepped(nodes: Nodes, steps: np.ndarray) -> Nodes:
    """T Exp(step), and the logarithm of the scale with its step."""
    T = poses_of(matrices_of(nodes.T_world) @ exp(steps[:, :6]))
    return put(nodes, T_world=T, log_scale=lambda scale: scale + steps[:, 6])


def chain(nodes: Nodes, edges: Factors) -> Nodes:
    """Poses by the measurements between neighbours, which come first, from the first pose on; scales 1."""
    poses, steps = [matrices_of(nodes.T_world)[0]], matrices_of(edges.Z_a_b)
    for row in range(nodes.valid.shape[0] - 1):
        poses.append(poses[-1] @ steps[row])
    return put(nodes, T_world=poses_of(np.stack(poses)), log_scale=lambda scale: 0 * scale)


def noisy_laps(num_nodes: int, num_loops: int, seed: int, std=STD) -> tuple[Nodes, PoseGraph]:
    """Truth, and the graph of two laps as it stands before a closure: the chain of its odometry. SE(3)."""
    rng, truth = np.random.default_rng(seed), walk(num_nodes)
    edges = measure(truth, window_pairs(num_nodes), std, rng)
    loops = measure_loops(truth, loop_pairs(num_nodes, num_loops), std, rng)
    edges = without_scale(join(edges, loops))
    return truth, PoseGraph(chain(truth, edges), edges)


def without_scale(edges: Factors) -> Factors:
    def without(roots):
        roots[:, 6] = 0.0
        return roots

    return put(edges, sqrt_info=without)


def error(nodes: Nodes, truth: Nodes) -> np.ndarray:
    """(n, 7) steps from the nodes to the truth."""
    steps = log(np.linalg.inv(matrices_of(nodes.T_world)) @ matrices_of(truth.T_world))
    return np.concatenate([steps, (np.asarray(truth.log_scale) - nodes.log_scale)[:, None]], axis=1)


def rmse(nodes: Nodes, truth: Nodes) -> float:
    """m, in the frame of the first pose."""
    difference = np.asarray(nodes.T_world.wxyz_xyz)[:, 4:] - np.asarray(truth.T_world.wxyz_xyz)[:, 4:]
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=-1))))

"""Pose graphs in g2o's format: `VERTEX_SE3:QUAT` and `EDGE_SE3:QUAT`."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.io.files import write_file
from emgs_jax.pose_graph.factors import Factors, Nodes, PoseGraph

VERTEX, EDGE = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"
FORMS = {VERTEX: "id x y z qx qy qz qw", EDGE: "id id x y z qx qy qz qw and the 21 numbers of the upper triangle"}
NUM_FIELDS = {VERTEX: (1, 7), EDGE: (2, 28)}  # ids, numbers
UPPER = np.triu_indices(6)
# A negative eigenvalue that is as small beside the largest is due to the digits of the file.
ROUNDING = 1e-6


def load_graph_g2o(path: str | os.PathLike, half_angles: bool = False) -> PoseGraph:
    """Read nodes, in the order of the file, and edges; those between neighbours in it are sequential, all others loops.

    Z of an edge `a b` is T_a⁻¹ T_b. Scales are not part of the format: log_scale is 0, the scale row not measured;
    solve with scale_std = 0. Lines that begin with # or FIX are read over (the first node is the gauge).

    Args:
        half_angles: the information on rotation is on the quaternion's vector part, half of the rotation vector near 0,
            as g2o itself defines it. False: on the rotation vector, as GTSAM reads the same files.

    Returns:
        A graph in float64, which `optimize` keeps.

    Raises:
        ValueError: naming the line, what is wrong and what to do.
    """
    ids: dict[int, int] = {}
    vertices, edges, measured = [], [], []
    lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    for number, line in enumerate(lines, start=1):
        fields = line.split("#")[0].split()
        if not fields or fields[0] == "FIX":
            continue
        names, values = _parse(fields, f"{path}:{number}")
        if fields[0] == VERTEX:
            if names[0] in ids:
                raise ValueError(f"{path}:{number}: vertex {names[0]} stands here a second time: remove one")
            ids[names[0]] = len(ids)
            vertices.append(values)
        else:
            edges.append((number, *names))
            measured.append(values)
    if not vertices or not edges:
        raise ValueError(f"{path}: needs lines {VERTEX} and {EDGE}; found {len(vertices)} and {len(edges)}")
    for number, *names in edges:
        if missing := [name for name in names if name not in ids]:
            raise ValueError(f"{path}:{number}: vertex {missing[0]} has no line {VERTEX}: add it or remove the edge")
    ends = np.array([[ids[name] for name in names] for _, *names in edges])
    measured = np.array(measured)
    roots = _roots(measured[:, 7:], half_angles, [f"{path}:{number}" for number, *_ in edges])
    return _graph(np.array(vertices), ends, measured[:, :7], roots)


def _parse(fields: list[str], place: str) -> tuple[list[int], list[float]]:
    """Ids and numbers of one line."""
    kind = fields[0]
    if kind not in FORMS:
        raise ValueError(f"{place}: {kind!r} is not read, only {VERTEX} and {EDGE}: remove the line or convert it")
    num_ids, num_values = NUM_FIELDS[kind]
    try:
        names, values = [int(field) for field in fields[1 : 1 + num_ids]], [float(x) for x in fields[1 + num_ids :]]
    except ValueError:
        names, values = [], []
    if len(names) != num_ids or len(values) != num_values or not np.isfinite(values).all():
        raise ValueError(f"{place}: expected `{kind} {FORMS[kind]}`, finite; got {' '.join(fields)[:80]!r}")
    if not any(values[3:7]):
        raise ValueError(f"{place}: the quaternion qx qy qz qw is 0 and no rotation: 0 0 0 1 is none")
    return names, values


def _roots(upper: np.ndarray, half_angles: bool, places: list[str]) -> np.ndarray:
    """W (e, 7, 7) with WᵀW the information (e, 21) by translation and rotation vector; the scale row is 0."""
    information = np.zeros((len(upper), 6, 6))
    information[:, UPPER[0], UPPER[1]] = upper
    information[:, UPPER[1], UPPER[0]] = upper
    unit = np.repeat([1.0, 0.5 if half_angles else 1.0], 3)
    values, vectors = np.linalg.eigh(information * unit * unit[:, None])
    bad = np.flatnonzero(values[:, 0] < -ROUNDING * values[:, -1])
    if len(bad):
        raise ValueError(
            f"{places[bad[0]]}: the information is not positive semidefinite: "
            "its 21 numbers are the upper triangle row by row, translation first"
        )
    roots = np.zeros((len(upper), 7, 7))
    roots[:, :6, :6] = np.sqrt(np.maximum(values, 0.0))[:, :, None] * vectors.transpose(0, 2, 1)
    return roots


def _graph(vertices: np.ndarray, ends: np.ndarray, poses: np.ndarray, roots: np.ndarray) -> PoseGraph:
    is_loop = np.abs(ends[:, 1] - ends[:, 0]) != 1
    with jax.enable_x64(True):
        a, b = jnp.asarray(ends, jnp.int32).T
        nodes = Nodes(_to_poses(vertices), jnp.zeros(len(vertices)), jnp.ones(len(vertices), bool))
        used, ratio = jnp.ones(len(ends), bool), jnp.zeros(len(ends))
        edges = Factors(a, b, _to_poses(poses), ratio, jnp.asarray(roots), jnp.asarray(is_loop), used)
    return PoseGraph(nodes, edges)


def _to_poses(values: np.ndarray) -> jaxlie.SE3:
    """x y z qx qy qz qw to poses."""
    return jaxlie.SE3(jnp.asarray(values[:, [6, 3, 4, 5, 0, 1, 2]])).normalize()


def save_graph_g2o(path: str | os.PathLike, graph: PoseGraph, half_angles: bool = False) -> None:
    """Write the valid nodes, by their row, and the valid edges; see `load_graph_g2o`.

    Raises:
        ValueError: a scale is not 1: the format has none.
    """
    nodes, edges = graph.nodes, graph.factors
    valid = np.asarray(nodes.valid)
    if np.any(np.asarray(nodes.log_scale)[valid] != 0):
        raise ValueError("g2o's format has no scales, and log_scale is not 0: write the map instead, or solve with 0")
    places = _to_g2o(nodes.T_world)
    lines = [f"{VERTEX} {row} {_numbers(places[row])}" for row in np.flatnonzero(valid)]
    roots = np.asarray(edges.sqrt_info, np.float64)[:, :, :6] * np.repeat([1.0, 2.0 if half_angles else 1.0], 3)
    upper = (roots.transpose(0, 2, 1) @ roots)[:, UPPER[0], UPPER[1]]
    values = np.concatenate([_to_g2o(edges.Z_a_b), upper], axis=1)
    for row in np.flatnonzero(np.asarray(edges.valid)):
        lines.append(f"{EDGE} {int(edges.a[row])} {int(edges.b[row])} {_numbers(values[row])}")
    write_file(path, "\n".join(lines) + "\n")


def _to_g2o(poses: jaxlie.SE3) -> np.ndarray:
    return np.asarray(poses.wxyz_xyz, np.float64)[:, [4, 5, 6, 1, 2, 3, 0]]


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.17g}" for value in values)

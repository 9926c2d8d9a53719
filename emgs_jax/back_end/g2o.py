"""Write pose graphs in g2o's format, for other solvers: `VERTEX_SE3:QUAT` and `EDGE_SE3:QUAT`."""

import os

import jaxlie
import numpy as np

from emgs_jax.io.files import write_file
from emgs_jax.pose_graph.factors import PoseGraph

VERTEX, EDGE = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"
UPPER = np.triu_indices(6)


def save_graph_g2o(path: str | os.PathLike, graph: PoseGraph) -> None:
    """Write the valid nodes, by their row, and the valid edges; the Z of an edge `a b` is T_a⁻¹ T_b.

    The information is on (translation, rotation vector), as GTSAM reads the format; g2o itself halves the angles.

    Raises:
        ValueError: a scale is not 1; the format has no scales.
    """
    nodes, edges = graph.nodes, graph.factors
    valid = np.asarray(nodes.valid)
    if np.any(np.asarray(nodes.log_scale)[valid] != 0):
        raise ValueError("g2o's format has no scales, and log_scale is not 0: write the map instead, or solve with 0")
    places = _to_g2o(nodes.T_world)
    lines = [f"{VERTEX} {row} {_numbers(places[row])}" for row in np.flatnonzero(valid)]
    roots = np.asarray(edges.sqrt_info, np.float64)[:, :, :6]
    upper = (roots.transpose(0, 2, 1) @ roots)[:, UPPER[0], UPPER[1]]
    values = np.concatenate([_to_g2o(edges.Z_a_b), upper], axis=1)
    for row in np.flatnonzero(np.asarray(edges.valid)):
        lines.append(f"{EDGE} {int(edges.a[row])} {int(edges.b[row])} {_numbers(values[row])}")
    write_file(path, "\n".join(lines) + "\n")


def _to_g2o(poses: jaxlie.SE3) -> np.ndarray:
    return np.asarray(poses.wxyz_xyz, np.float64)[:, [4, 5, 6, 1, 2, 3, 0]]


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.17g}" for value in values)

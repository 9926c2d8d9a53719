"""Pose graphs of g2o files, as other programs read them."""

from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.pose_graph.factors import Factors, Nodes, PoseGraph


def load_graph_g2o(path: Path) -> PoseGraph:
    """Nodes in the order of the file, and edges, in float64; those of neighbours in it are sequential, others loops.

    The information is on (translation, rotation vector); the scale row of `sqrt_info` is 0.
    """
    rows = [line.split() for line in path.read_text().splitlines()]
    vertices = [row for row in rows if row[0] == "VERTEX_SE3:QUAT"]
    edges = [row for row in rows if row[0] == "EDGE_SE3:QUAT"]
    order = {row[1]: number for number, row in enumerate(vertices)}
    ends = np.array([[order[name] for name in row[1:3]] for row in edges])
    measured = np.array([row[3:] for row in edges], np.float64)
    information = np.zeros((len(edges), 6, 6))
    information[:, *np.triu_indices(6)] = measured[:, 7:]
    values, vectors = np.linalg.eigh(information, UPLO="U")
    roots = np.zeros((len(edges), 7, 7))
    roots[:, :6, :6] = np.sqrt(np.maximum(values, 0.0))[:, :, None] * vectors.transpose(0, 2, 1)
    with jax.enable_x64(True):
        known = jnp.ones(len(vertices), bool), jnp.ones(len(edges), bool)
        nodes = Nodes(_poses([row[2:] for row in vertices]), jnp.zeros(len(vertices)), known[0])
        is_loop = jnp.asarray(np.abs(ends[:, 1] - ends[:, 0]) != 1)
        a, b = jnp.asarray(ends, jnp.int32).T
        poses, ratio = _poses(measured[:, :7]), jnp.zeros(len(edges))
        return PoseGraph(nodes, Factors(a, b, poses, ratio, jnp.asarray(roots), is_loop, known[1]))


def _poses(rows) -> jaxlie.SE3:
    """Of rows of x y z qx qy qz qw."""
    return jaxlie.SE3(jnp.asarray(np.array(rows, np.float64)[:, [6, 3, 4, 5, 0, 1, 2]])).normalize()

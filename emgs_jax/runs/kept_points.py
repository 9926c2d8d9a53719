"""The frames' own points of finished runs, moved into the map that merges them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from emgs_jax.back_end.state import Node
from emgs_jax.evaluation.clouds import PART_ROWS, NearestPoints, PointCloud
from emgs_jax.gaussian_map import GaussianMap, confirmed
from emgs_jax.io.ply_reader import read_vertices
from emgs_jax.mapping.atlas import Atlas
from emgs_jax.mapping.merging import motion
from emgs_jax.pose_graph.deform import DeformConfig

COLUMNS = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")


@dataclass(frozen=True)
class Moved:
    """A run's map with its nodes before a merge, and the same nodes after it."""

    map: GaussianMap
    before: Sequence[Node]
    after: Sequence[Node]


def read_points(path: Path) -> PointCloud:
    """Read the points.ply of a run; a normal of zero stays unknown."""
    vertices = read_vertices(path)
    points, normals, colors = (np.stack([vertices[name] for name in names], 1).astype(np.float64) for names in COLUMNS)
    return PointCloud(points, normals, colors / 255.0)


def moved_parts(parts: Sequence[Atlas], nodes: Sequence[Node]) -> list[Moved]:
    """Find the nodes of each run among those of the merged one: nodes of saved maps first, then the runs in order."""
    saved, own, found = 0, sum(part.graph.first_node for part in parts), []
    for part in parts:
        before, first = part.graph.nodes, part.graph.first_node
        after = [*nodes[saved : saved + first], *nodes[own : own + len(before) - first]]
        found.append(Moved(part.state.map, before, after))
        saved, own = saved + first, own + len(before) - first
    return found


def moved_points(cloud: PointCloud, moved: Moved, config: DeformConfig) -> PointCloud:
    """Move each point of a run with the frames that made the Gaussians around it, as `deform` moves a Gaussian."""
    gaussians = confirmed(moved.map)
    means, is_known, births = jax.device_get((gaussians.means, gaussians.valid, moved.map.birth))
    births, tree = births[is_known], NearestPoints(means[is_known])
    motions = np.stack([motion(*pair).as_matrix() for pair in zip(moved.before, moved.after, strict=True)])
    step, points, normals = PART_ROWS // config.num_neighbours, [np.empty((0, 3))], [np.empty((0, 3))]
    for begin in range(0, len(cloud), step):
        some = slice(begin, begin + step)
        of_nodes = births[tree.query(cloud.points[some], config.num_neighbours)[1]]
        counts = np.abs(of_nodes - of_nodes[:, :1]) <= float(config.max_gap)
        mean = np.einsum("nk,nkij->nij", counts / counts.sum(1, keepdims=True), motions[of_nodes])
        points.append(np.einsum("nij,nj->ni", mean[:, :3, :3], cloud.points[some]) + mean[:, :3, 3])
        normals.append(np.einsum("nij,nj->ni", mean[:, :3, :3], cloud.normals[some]))
    turned = np.concatenate(normals)
    lengths = np.linalg.norm(turned, axis=1, keepdims=True)
    return PointCloud(np.concatenate(points), turned / np.where(lengths > 0, lengths, 1.0), cloud.colors)

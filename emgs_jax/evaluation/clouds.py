"""Point clouds: reading and moving them, and averaging them per voxel without holding all points at once."""

import os
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from emgs_jax.data.spool import Spool
from emgs_jax.evaluation.trajectory import align
from emgs_jax.geometry import Sim3, rotated
from emgs_jax.io.ply_reader import read_vertices
from emgs_jax.ops.ranges import MAX_LENGTH_M

_NORMALS, _COLORS = ("nx", "ny", "nz"), ("red", "green", "blue")
_MERGE_ROWS = 1_000_000  # fewest pending rows that are merged: bounds the memory, does not change the result


@dataclass(frozen=True)
class PointCloud:
    """Points with attributes; float64 rows. A normal of zero is unknown and left out of the normal metrics.

    Args:
        points: (n, 3), metres.
        normals: (n, 3), unit length and towards the camera that saw them, or zero.
        colors: (n, 3), RGB in [0, 1].
    """

    points: np.ndarray
    normals: np.ndarray
    colors: np.ndarray

    def __len__(self) -> int:
        return len(self.points)


def read_cloud(path: str | os.PathLike, normal_neighbours: int) -> PointCloud:
    """Read a PLY; a cloud without normals gets those of planes through so many nearest points, sign unknown.

    Normals that are 0, as 3DGS writes them, are none; the others get length 1.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path} is no file: give a PLY file with the points in the trajectory's frame")
    vertices = read_vertices(path)
    points = _columns(vertices, ("x", "y", "z"), path)
    far = np.abs(points).max(initial=0.0)
    if far > MAX_LENGTH_M:
        raise ValueError(f"{path} has a point {far:g} m away: give the points in metres, and without stray ones")
    if not len(points):
        raise ValueError(f"{path} has no points: write the points of the map as PLY")
    has_normals, has_colors = ({*names} <= vertices.keys() for names in (_NORMALS, _COLORS))
    normals = _columns(vertices, _NORMALS, path) if has_normals else np.zeros_like(points)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    if not lengths.all():
        normals = np.where(lengths > 0, normals, _fitted_normals(points, normal_neighbours))
    normals = normals / np.where(lengths > 0, lengths, 1.0)
    return PointCloud(points, normals, _columns(vertices, _COLORS, path) if has_colors else np.zeros_like(points))


def _columns(vertices: Mapping[str, np.ndarray], names: Sequence[str], path: object) -> np.ndarray:
    """Properties (n, 3) as float64, colours as fractions of 1, 255 or 65535, by their largest; all must be finite."""
    rows = np.stack([vertices[name].astype(np.float64) for name in names], axis=1)
    num_broken = int((~np.isfinite(rows).all(1)).sum())
    if num_broken:
        what = f"points are not finite in {', '.join(names)}"
        raise ValueError(f"{path}: {num_broken} of {len(rows)} {what}: leave them out of the file")
    if names != _COLORS:
        return rows
    is_float = vertices[names[0]].dtype.kind == "f"  # programs write 0 … 255 in any kind
    return rows / next((top for top in (1.0,) * is_float + (255.0, 65535.0) if rows.max(initial=0.0) <= top), np.inf)


def _fitted_normals(points: np.ndarray, num_neighbours: int) -> np.ndarray:
    import open3d as o3d  # slow to import, and only clouds of other systems need it

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(num_neighbours))
    return np.asarray(cloud.normals)


def transform_cloud(cloud: PointCloud, alignment: Sim3) -> PointCloud:
    """Bring a cloud into the reference's frame."""
    return PointCloud(alignment.apply(cloud.points), rotated(cloud.normals, alignment.rotation), cloud.colors)


class VoxelGrid:
    """Averages all points that share a voxel [m] of the world grid, however they are spread over the clouds.

    Rows come out ordered by cell, so the result is deterministic; points that are not finite are dropped.
    """

    def __init__(self, voxel: float) -> None:
        self._voxel = voxel
        self._tables: list[tuple[np.ndarray, np.ndarray]] = []  # cells of the clouds; the first may hold many of them

    def add(self, cloud: PointCloud) -> None:
        """Add the points of a cloud."""
        self._tables.append(_cells(cloud, self._voxel))
        if sum(len(keys) for keys, _ in self._tables[1:]) > max(_MERGE_ROWS, len(self._tables[0][0])):
            self._tables = [_merge(self._tables)]

    def cloud(self) -> PointCloud:
        """The mean of each occupied voxel so far."""
        sums = self._sums()
        means = sums[:, :9] / sums[:, 9:]
        length = np.linalg.norm(means[:, 3:6], axis=1, keepdims=True)
        # Two sides of a thin sheet cancel: a short mean says nothing about the direction.
        normals = np.where(length > 0.1, means[:, 3:6] / np.maximum(length, 0.1), 0.0)
        return PointCloud(means[:, :3], normals, means[:, 6:9])

    def counts(self) -> np.ndarray:
        """Count the points that were averaged for each row of `cloud`."""
        return self._sums()[:, 9]

    def _sums(self) -> np.ndarray:
        if len(self._tables) != 1:
            self._tables = [_merge([(np.empty(0, np.int64), np.empty((0, 10))), *self._tables])]
        return self._tables[0][1]


def fuse_clouds(clouds: Iterable[PointCloud], voxel: float) -> PointCloud:
    """Average the points of all clouds as a `VoxelGrid` does."""
    grid = VoxelGrid(voxel)
    for cloud in clouds:
        grid.add(cloud)
    return grid.cloud()


class SpooledCloud:
    """All points of many clouds, in a temporary file, averaged once the side of a voxel is known.

    What is not metric has a unit that only its alignment tells: 1 cm of the truth is .01 of one estimate's lengths and
    .00001 of another's. float32 (n, 9) a cloud.
    """

    def __init__(self) -> None:
        self._parts, self._count = Spool(), 0
        self._averaged: tuple[float, PointCloud] | None = None  # the last answer: one alignment serves several numbers
        self._averaging = threading.Lock()  # threads that place the cloud differently ask for the same average

    def append(self, cloud: PointCloud) -> None:
        """Add the points of a cloud."""
        self._parts.append(np.concatenate([cloud.points, cloud.normals, cloud.colors], axis=1).astype(np.float32))
        self._count, self._averaged = self._count + len(cloud), None

    def __len__(self) -> int:
        return self._count

    def averaged(self, voxel: float) -> PointCloud:
        """The points, averaged per voxel [lengths of the clouds]."""
        with self._averaging:
            if self._averaged is None or self._averaged[0] != voxel:
                parts = (self._parts[row].astype(np.float64) for row in range(len(self._parts)))
                self._averaged = voxel, fuse_clouds((PointCloud(p[:, :3], p[:, 3:6], p[:, 6:]) for p in parts), voxel)
            return self._averaged[1]


def cell_numbers(points: np.ndarray, voxel: float) -> np.ndarray:
    """Number (n,) of the voxel [m] of the world that each finite point (n, 3) is in, 21 bits an axis.

    What is farther than a million voxels shares the border cells.
    """
    index = np.floor(np.clip(points / voxel, -(2.0**20), 2.0**20 - 1)).astype(np.int64) + 2**20
    return (index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2]


def cell_centers(numbers: np.ndarray, voxel: float) -> np.ndarray:
    """Centres (n, 3) of the voxels with these `cell_numbers`."""
    index = (numbers[:, None] >> np.array([42, 21, 0])) & (2**21 - 1)
    return (index - 2**20 + 0.5) * voxel


def voxel_downsample(cloud: PointCloud, voxel: float) -> PointCloud:
    """Average the points of each voxel [m]; doing it twice changes nothing."""
    return fuse_clouds([cloud], voxel)


class NearestPoints:
    """Exact nearest neighbours among points (n, 3), by Open3D: SciPy's k-d tree takes twice as long for a scene.

    Args:
        points: (n, 3), of any unit.
    """

    def __init__(self, points: np.ndarray) -> None:
        self.points = np.ascontiguousarray(points, np.float64)
        self._search: Any = None

    def __len__(self) -> int:
        return len(self.points)

    def query(self, queries: np.ndarray, num_neighbours: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Distances and rows, (m, k) each and the nearest first, of k = min(`num_neighbours`, n) points."""
        k = min(num_neighbours, len(self))
        if not k or not len(queries):
            return np.empty((len(queries), k)), np.empty((len(queries), k), np.int64)
        import open3d as o3d  # slow to import, and only a comparison needs it

        if self._search is None:
            self._search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(self.points))
            self._search.knn_index()
        queries = o3d.core.Tensor(np.ascontiguousarray(queries, np.float64))
        rows, squares = (found.numpy() for found in self._search.knn_search(queries, k))
        return np.sqrt(squares), rows


def register(points: np.ndarray, target: NearestPoints, max_distance: float, max_steps: int) -> Sim3:
    """Find the rigid motion of points (n, 3) onto those of a target by point-to-point ICP (Besl and McKay 1992).

    Pairs are nearest points within `max_distance` [m]; ends when they stay the same. With fewer than 3 pairs nothing
    holds the cloud: it stays where it is.
    """
    found, known = Sim3(1.0, np.eye(3), np.zeros(3)), np.empty(0)
    if not len(target):
        return found
    for _ in range(max_steps):
        distances, partners = (values[:, 0] for values in target.query(found.apply(points)))
        near = distances < max_distance
        pairs = np.where(near, partners, -1)
        if near.sum() < 3 or np.array_equal(pairs, known):
            return found
        found, known = align(points[near], target.points[partners[near]], with_scale=False), pairs
    return found


def _cells(cloud: PointCloud, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Reduce one cloud to its occupied cells: packed cell numbers (n,), sorted, and sums (n, 10), the last a count."""
    finite = np.isfinite(cloud.points).all(axis=1)
    points = np.asarray(cloud.points[finite], np.float64)
    keys = cell_numbers(points, voxel)
    rows = np.concatenate([points, cloud.normals[finite], cloud.colors[finite], np.ones((len(points), 1))], axis=1)
    return _sum_cells(keys, rows)


def _merge(tables: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    return _sum_cells(*(np.concatenate(column) for column in zip(*tables, strict=True)))


def _sum_cells(keys: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum the rows (n, 10) of equal keys (n,), in the order in which they stand."""
    order = np.argsort(keys, kind="stable")
    begins = np.flatnonzero(np.diff(keys[order], prepend=-1))
    # A sparse matrix that picks the rows of each cell: whole rows are read once, whatever the number of columns.
    picks = csr_array((np.ones(len(keys)), order, np.append(begins, len(keys))), shape=(len(begins), len(keys)))
    return keys[order][begins], picks @ rows

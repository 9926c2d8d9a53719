"""Point clouds: read them, move them, and average them per voxel without holding all points at once."""

import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from emgs_jax.data.spool import Spool
from emgs_jax.evaluation.trajectory import align
from emgs_jax.geometry import Sim3, rotated
from emgs_jax.io.ply_reader import read_vertices
from emgs_jax.ops.ranges import MAX_LENGTH_M

_NORMALS, _COLORS = ("nx", "ny", "nz"), ("red", "green", "blue")
PART_ROWS = 500_000  # points in memory at a time; does not change the result
SOME = 61  # of so many points one decides where a cloud is divided


@dataclass(frozen=True)
class PointCloud:
    """Points with attributes, float64; a normal of zero is unknown and left out of metrics of normals."""

    points: np.ndarray  # (n, 3), metres
    normals: np.ndarray  # (n, 3), unit length and towards the camera that saw them, or zero
    colors: np.ndarray  # (n, 3), RGB in [0, 1]

    def __len__(self) -> int:
        return len(self.points)


def read_cloud(path: str | os.PathLike, normal_neighbours: int) -> PointCloud:
    """Read a PLY; where a normal is missing or 0, it is that of a plane through the nearest points, sign unknown."""
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
    """Stack finite properties as float64 (n, 3); colours are divided by 1, 255 or 65535, by the largest."""
    rows = np.stack([vertices[name].astype(np.float64) for name in names], axis=1)
    num_broken = int((~np.isfinite(rows).all(1)).sum())
    if num_broken:
        what = f"points are not finite in {', '.join(names)}"
        raise ValueError(f"{path}: {num_broken} of {len(rows)} {what}: leave them out of the file")
    if names != _COLORS:
        return rows
    is_float = vertices[names[0]].dtype.kind == "f"  # programs write 0 … 255 in any type
    return rows / next((top for top in (1.0,) * is_float + (255.0, 65535.0) if rows.max(initial=0.0) <= top), np.inf)


def _fitted_normals(points: np.ndarray, num_neighbours: int) -> np.ndarray:
    """Normals (n, 3) of planes through the nearest distinct points, sign unknown; 0 where these lie on a line."""
    distinct, rows = np.unique(points, axis=0, return_inverse=True)
    search, normals = NearestPoints(distinct), np.zeros_like(distinct)
    for begin in range(0, len(distinct), PART_ROWS // num_neighbours):
        part = slice(begin, begin + PART_ROWS // num_neighbours)
        near = distinct[search.query(distinct[part], num_neighbours)[1]]
        offsets = near - near.mean(1, keepdims=True)
        spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
        normals[part] = np.where(spread[:, 1:2] > 1e-6 * spread[:, 2:], axes[:, :, 0], 0.0)
    return normals[rows.reshape(-1)]


def transform_cloud(cloud: PointCloud, alignment: Sim3) -> PointCloud:
    """Apply a Sim(3) to a cloud."""
    return PointCloud(alignment.apply(cloud.points), rotated(cloud.normals, alignment.rotation), cloud.colors)


@dataclass(frozen=True)
class VoxelMeans:
    """The mean of each occupied voxel of a cloud, in parts on disk.

    A part has rows (n, 10): point, normal (unit or zero), colour and number of points; or (n, 7) without colours. All
    rows are sorted by the number of their cell.
    """

    parts: Spool
    sizes: tuple[int, ...]  # rows of each part
    width: int = 10  # columns

    def __len__(self) -> int:
        return sum(self.sizes)

    def tables(self) -> Iterator[np.ndarray]:
        return (self.parts[part] for part in range(len(self.sizes)))

    def __iter__(self) -> Iterator[PointCloud]:
        return map(_cloud, self.tables())

    def rows(self, positions: np.ndarray) -> np.ndarray:
        """Rows (m, `width`) at positions (m,) in ascending order."""
        begins = np.cumsum((0, *self.sizes))
        ends = np.searchsorted(positions, begins)
        found = [
            part[positions[first:last] - begin]
            for part, begin, first, last in zip(self.tables(), begins, ends, ends[1:], strict=False)
        ]
        return np.concatenate([np.empty((0, self.width), np.float32), *found])

    def cloud(self) -> PointCloud:
        return _cloud(np.concatenate([np.empty((0, 10), np.float32), *self.tables()]))

    def counts(self) -> np.ndarray:
        """The number of points of each row of `cloud`."""
        return np.concatenate([np.empty(0), *(part[:, -1] for part in self.tables())])


class SpooledRows:
    """Rows (n, c) that begin with a position, in a temporary file until the side of a voxel is known.

    Only the alignment tells the unit of an estimate. Rows without a finite position are dropped.
    """

    def __init__(self, dtype: type = np.float32) -> None:
        self._parts, self._some, self._count, self.dtype = Spool(), [np.empty((0, 3), dtype)], 0, dtype

    def append(self, rows: np.ndarray) -> None:
        """Add rows."""
        is_finite = np.isfinite(rows[:, 0]) & np.isfinite(rows[:, 1]) & np.isfinite(rows[:, 2])
        rows = (rows if is_finite.all() else rows[is_finite]).astype(self.dtype, copy=False)
        self._parts.append(rows)
        self._some.append(rows[::SOME, :3].copy())
        self._count += len(rows)

    def __len__(self) -> int:
        return self._count

    def by_ranges(self, voxel: float, read: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Iterator:
        """Yield the rows by ranges of cells, about `PART_ROWS` rows at a time, in the order in which they were added.

        `read` maps rows that were added together to the numbers of their cells, and to what is yielded of them.
        """
        numbers, num_parts = np.sort(cell_numbers(np.concatenate(self._some), voxel)), -(-len(self) // PART_ROWS)
        edges = numbers[len(numbers) * np.arange(1, num_parts) // max(num_parts, 1)]
        if not len(edges):  # one range
            parts = [read(self._parts[part])[1] for part in range(len(self._parts))]
            yield from [np.concatenate(parts)] if parts else ()
            return
        spread, places = Spool(), [[] for _ in range(len(edges) + 1)]
        for part in range(len(self._parts)):
            cells, rows = read(self._parts[part])
            which = np.searchsorted(edges, cells, side="right").astype(np.uint16)
            order = np.argsort(which, kind="stable")  # 16 bits are sorted digit by digit
            ends = np.cumsum(np.bincount(which, minlength=len(places)))
            for place, own in zip(places, np.split(order, ends[:-1]), strict=True):
                if len(own):
                    place.append(spread.append(rows[own]))
        for place in filter(None, places):
            yield np.concatenate([spread[position] for position in place])


class SpooledCloud:
    """The points of many clouds as `SpooledRows` (n, 9): point, normal, colour; (n, 6) without colours."""

    def __init__(self, dtype: type = np.float32, has_colors: bool = True) -> None:
        self._rows, self._width = SpooledRows(dtype), 9 if has_colors else 6
        self._averaged: tuple[float, VoxelMeans] | None = None  # the last result, for several metrics of one alignment
        self._averaging = threading.Lock()

    def append(self, cloud: PointCloud) -> None:
        """Add the points of a cloud."""
        rows = np.empty((len(cloud), self._width), self._rows.dtype)
        rows[:, :3], rows[:, 3:6] = cloud.points, cloud.normals
        rows[:, 6:] = cloud.colors[:, : self._width - 6]
        self._rows.append(rows)
        self._averaged = None

    def __len__(self) -> int:
        return len(self._rows)

    def averaged(self, voxel: float) -> VoxelMeans:
        """The mean of each voxel of the world grid; `voxel` is its side, in the clouds' unit."""
        with self._averaging:
            if self._averaged is None or self._averaged[0] != voxel:
                means, sizes = Spool(), []
                for rows in self._rows.by_ranges(voxel, lambda rows: (cell_numbers(rows[:, :3], voxel), rows)):
                    means.append(found := _means(rows, voxel))
                    sizes.append(len(found))
                self._averaged = voxel, VoxelMeans(means, tuple(sizes), self._width + 1)
            return self._averaged[1]


def spooled(clouds: Iterable[PointCloud], dtype: type = np.float32, has_colors: bool = True) -> SpooledCloud:
    """Spool clouds, one in memory at a time."""
    found = SpooledCloud(dtype, has_colors)
    for cloud in clouds:
        found.append(cloud)
    return found


def fuse_clouds(clouds: Iterable[PointCloud], voxel: float) -> PointCloud:
    """Average the points of all clouds per voxel, to float32."""
    return spooled(clouds).averaged(voxel).cloud()


def coarse_points(parts: Iterable[np.ndarray], voxel: float) -> np.ndarray:
    """Mean (n, 3) in each voxel of the points (m, 3) of all parts; one part is in memory at a time."""
    tables = [(np.empty(0, np.int64), np.empty((0, 4)))]
    for points in parts:
        tables.append(_sum_cells(cell_numbers(points, voxel), np.column_stack([points, np.ones(len(points))])))
    _, sums = _sum_cells(*(np.concatenate(column) for column in zip(*tables, strict=True)))
    return sums[:, :3] / sums[:, 3:]


def cell_numbers(points: np.ndarray, voxel: float) -> np.ndarray:
    """Number of the voxel [m] of each finite point (n, 3), 21 bits an axis; beyond a million voxels a border cell."""
    numbers = np.zeros(len(points), np.int64)
    for axis in range(3):  # by column, as there may be millions of rows
        cells = np.asarray(points[:, axis], np.float64) / voxel
        np.floor(cells, out=cells)
        np.clip(cells, -(2.0**20), 2.0**20 - 1, out=cells)
        numbers <<= 21
        numbers |= cells.astype(np.int64) + 2**20
    return numbers


def cell_centers(numbers: np.ndarray, voxel: float) -> np.ndarray:
    """Centres (n, 3) of the voxels with these `cell_numbers`."""
    centers = np.empty((len(numbers), 3))
    for axis, shift in enumerate((42, 21, 0)):  # by column, as there may be tens of millions of rows
        centers[:, axis] = ((numbers >> shift) & (2**21 - 1)) - 2**20 + 0.5
    centers *= voxel
    return centers


class NearestPoints:
    """Exact nearest neighbours among points (n, 3); releases the GIL."""

    def __init__(self, points: np.ndarray) -> None:
        self.points = np.ascontiguousarray(points, np.float64)
        # With `compact_nodes` a query far from all points visits ten times as many leaves.
        self._tree = cKDTree(self.points, leafsize=32, balanced_tree=False, compact_nodes=False)

    def __len__(self) -> int:
        return len(self.points)

    def query(self, queries: np.ndarray, num_neighbours: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Distances and rows (m, k) of the k = min(`num_neighbours`, n) nearest points, nearest first."""
        k = min(num_neighbours, len(self))
        if not k or not len(queries):
            return np.empty((len(queries), k)), np.empty((len(queries), k), np.int64)
        return self._tree.query(queries, np.arange(1, k + 1), workers=-1)


def register(points: np.ndarray, target: NearestPoints, max_distance: float, max_steps: int) -> Sim3:
    """Find the rigid motion of points (n, 3) onto a target by point-to-point ICP (Besl and McKay 1992).

    Pairs are nearest points within `max_distance` [m]. Ends when a step moves them by less than 1e-5 of it (RMS), or
    with fewer than 3 pairs.
    """
    found, moved, shift = Sim3(1.0, np.eye(3), np.zeros(3)), points, np.inf
    for _ in range(max_steps if len(target) else 0):
        distances, partners = (values[:, 0] for values in target.query(moved))
        near = distances < max_distance
        if near.sum() < 3 or shift < 1e-5 * max_distance:
            return found
        found = align(points[near], target.points[partners[near]], with_scale=False)
        moved, before = found.apply(points), moved
        shift = np.sqrt(np.mean(np.sum((moved - before)[near] ** 2, axis=1)))
    return found


def _cloud(rows: np.ndarray) -> PointCloud:
    return PointCloud(*(rows[:, begin : begin + 3].astype(np.float64) for begin in (0, 3, 6)))


def _means(rows: np.ndarray, voxel: float) -> np.ndarray:
    """Rows of `VoxelMeans` from rows (n, 9) or (n, 6)."""
    _, sums = _sum_cells(cell_numbers(rows[:, :3], voxel), np.column_stack([rows, np.ones(len(rows))]))
    sums[:, :-1] /= sums[:, -1:]
    length = np.linalg.norm(sums[:, 3:6], axis=1, keepdims=True)
    # Normals of the two sides of a thin sheet cancel: a short mean has no direction.
    sums[:, 3:6] = np.where(length > 0.1, sums[:, 3:6] / np.maximum(length, 0.1), 0.0)
    return sums.astype(rows.dtype)


def _sum_cells(keys: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum the rows (n, c) of equal keys (n,) in float64, in their order."""
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    begins = np.flatnonzero(np.diff(keys, prepend=-1))
    # A sparse matrix that picks the rows of each cell reads whole rows once.
    picks = csr_array((np.ones(len(keys)), order, np.append(begins, len(keys))), shape=(len(begins), len(keys)))
    return keys[begins], picks @ rows

"""Baselines without mapping: predictions averaged per voxel, or their depth fused (TSDF).

Both take views one by one and keep none. Lengths are in the unit of the poses, to which `start` converts metres.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from emgs_jax.data.backprojection import backproject
from emgs_jax.evaluation.clouds import PointCloud, SpooledCloud, cell_centers, cell_numbers, transform_cloud
from emgs_jax.geometry import Sim3, rotated
from emgs_jax.ops.ranges import number

_BLOCK_VOXELS = 32  # a side of the cubes that a camera sees or not
Image = tuple[np.ndarray, np.ndarray]  # camera-space z (h, w), 0 where there is none, and RGB in [0, 1], (h, w, 3)
Draw = Callable[[np.ndarray], Image]  # from the pose T_world_camera (4, 4)


@dataclass(frozen=True)
class View:
    """Prediction of one frame, in its camera's frame and the prior's unit."""

    depth: np.ndarray  # camera-space z (h, w), 0 where there is none
    image: np.ndarray  # RGB, uint8 (h, w, 3)
    cloud: PointCloud


@dataclass(frozen=True)
class Pinhole:
    """The camera of all frames: fx, fy, cx, cy with pixel centres at integers, and the image's size."""

    intrinsics: tuple[float, float, float, float]
    width: int
    height: int


@dataclass(frozen=True)
class VoxelConfig:
    """The mean of all points of each voxel; see `draw_voxels`."""

    voxel_m: float = number(0.02, low=1e-6)
    # Largest reach of a point's square to each side: a voxel just before the camera would fill the image.
    max_footprint_px: int = number(8, low=1, high=4096)
    surface_depth: float = number(0.1, low=0)
    min_points: int = number(10, low=1)

    def start(self, pinhole: Pinhole, unit: float) -> "Fusion":
        """Start an empty fusion; a length of the poses is `unit` metres."""
        return _Voxels(replace(self, voxel_m=self.voxel_m / unit), pinhole)


@dataclass(frozen=True)
class TsdfConfig:
    """A truncated signed distance field (Curless and Levoy 1996), fused by Open3D on the CPU."""

    voxel_m: float = number(0.02, low=1e-6)
    truncation_m: float = number(0.08, low=1e-6)  # more than a depth's noise; nearer surfaces disturb each other
    min_views: int = number(1, low=1)  # that must have seen a place

    def __post_init__(self) -> None:
        if self.truncation_m < self.voxel_m:
            raise ValueError(
                f"baseline.tsdf.truncation_m={self.truncation_m} is less than one voxel ({self.voxel_m}): no surface "
                "would be found; take some voxels"
            )

    def start(self, pinhole: Pinhole, unit: float) -> "Fusion":
        """Start an empty fusion; a length of the poses is `unit` metres."""
        lengths = replace(self, voxel_m=self.voxel_m / unit, truncation_m=self.truncation_m / unit)
        return _Tsdf(lengths, pinhole)


BaselineConfig = VoxelConfig | TsdfConfig


class _Voxels:
    """The mean of the points of each voxel."""

    def __init__(self, config: VoxelConfig, pinhole: Pinhole) -> None:
        self._config, self._pinhole, self._points = config, pinhole, SpooledCloud()

    def add(self, view: View, T_world_camera: np.ndarray, scale: float) -> None:
        """Add a view at a pose; `scale` brings its lengths to those of the pose."""
        motion = Sim3(scale, T_world_camera[:3, :3], T_world_camera[:3, 3])
        self._points.append(transform_cloud(view.cloud, motion))

    def cloud(self) -> PointCloud:
        """The fused cloud so far, with normals towards the cameras."""
        return self._points.averaged(self._config.voxel_m).cloud()

    def renderer(self) -> Draw:
        """Return a function that draws the fused cloud so far."""
        means = self._points.averaged(self._config.voxel_m)
        blocks = _Blocks(means.cloud(), means.counts(), _BLOCK_VOXELS * self._config.voxel_m)

        def draw(T_world_camera: np.ndarray) -> Image:
            rows = blocks.before(T_world_camera, self._pinhole, self._config)
            some = PointCloud(*(values[rows] for values in vars(blocks.cloud).values()))
            return draw_voxels(some, blocks.counts[rows], T_world_camera, self._pinhole, self._config)

        return draw


class _Tsdf:
    """Open3D's TSDF, with the methods of `_Voxels`."""

    _BLOCK, _BLOCKS = 8, 2000  # voxels a side; blocks at the start, which grow
    # In voxels. Open3D finds no surface where the field is exactly 0 at a voxel, as for a wall at a round distance.
    _SHIFT = 0.37

    def __init__(self, config: TsdfConfig, pinhole: Pinhole) -> None:
        import open3d as o3d  # slow to import, and only these baselines need it

        self._o3d, self._config, self._pinhole = o3d, config, pinhole
        names, kinds, widths = ("tsdf", "weight", "color"), (o3d.core.float32,) * 3, ((1), (1), (3))
        self._shift = self._SHIFT * config.voxel_m
        self._threshold = config.min_views - 0.5  # the weight, a count of views, has to be above it
        self._grid = o3d.t.geometry.VoxelBlockGrid(names, kinds, widths, config.voxel_m, self._BLOCK, self._BLOCKS)

    def add(self, view: View, T_world_camera: np.ndarray, scale: float) -> None:
        depth = (scale * view.depth).astype(np.float32)
        if not depth.any():
            return
        fx, fy, cx, cy = self._pinhole.intrinsics
        # Open3D takes the pixel in which a voxel falls, with pixel centres at halves.
        matrix = np.array([[fx, 0.0, cx + 0.5], [0.0, fy, cy + 0.5], [0.0, 0.0, 1.0]])
        T_camera_world = self._tensor(np.linalg.inv(self._shifted(T_world_camera)))
        limits = 1.0, float(2.0 * depth.max()), self._config.truncation_m / self._config.voxel_m
        # It makes blocks for every fourth pixel only, so small images would have gaps: each pixel becomes four here.
        dense = self._image(depth.repeat(4, axis=0).repeat(4, axis=1))
        larger = self._tensor(np.diag([4.0, 4.0, 1.0]) @ matrix)
        blocks = self._grid.compute_unique_block_coordinates(dense, larger, T_camera_world, *limits)
        images = self._image(depth), self._image(view.image.astype(np.float32) / 255.0)
        self._grid.integrate(blocks, *images, self._tensor(matrix), T_camera_world, *limits)

    def cloud(self) -> PointCloud:
        if not self._grid.hashmap().size():
            return PointCloud(*[np.zeros((0, 3))] * 3)
        found = self._grid.extract_point_cloud(self._threshold).point
        rows = [found[name].numpy().astype(np.float64) for name in ("positions", "normals", "colors")]
        rows[0] -= self._shift
        order = np.lexsort(rows[0].T)  # threads return them in any order
        return PointCloud(*(values[order] for values in rows))

    def renderer(self) -> Draw:
        mesh = self._grid.extract_triangle_mesh(self._threshold) if self._grid.hashmap().size() else None
        if mesh is None or not len(mesh.triangle.indices):
            return lambda T: _nothing(self._pinhole)
        scene = self._o3d.t.geometry.RaycastingScene()
        scene.add_triangles(mesh)
        triangles, colors = mesh.triangle.indices.numpy(), mesh.vertex.colors.numpy()

        def draw(T_world_camera: np.ndarray) -> Image:
            pinhole, T_world_camera = self._pinhole, self._shifted(T_world_camera)
            rays = backproject(np.ones((pinhole.height, pinhole.width)), pinhole.intrinsics) @ T_world_camera[:3, :3].T
            origins = np.broadcast_to(T_world_camera[:3, 3], rays.shape)
            hits = scene.cast_rays(self._o3d.core.Tensor(np.concatenate([origins, rays], -1).astype(np.float32)))
            depth = hits["t_hit"].numpy()  # of rays whose camera-space z is 1
            is_hit = np.isfinite(depth)
            u, v = np.moveaxis(hits["primitive_uvs"].numpy()[is_hit], -1, 0)
            corners = colors[triangles[hits["primitive_ids"].numpy()[is_hit]]]
            blended = np.zeros((*depth.shape, 3))
            blended[is_hit] = np.einsum("nc,ncd->nd", np.stack([1.0 - u - v, u, v], 1), corners)
            return np.where(is_hit, depth, 0.0), blended

        return draw

    def _shifted(self, T_world_camera: np.ndarray) -> np.ndarray:
        moved = np.array(T_world_camera, np.float64)
        moved[:3, 3] += self._shift
        return moved

    def _image(self, values: np.ndarray) -> Any:
        return self._o3d.t.geometry.Image(self._o3d.core.Tensor(np.ascontiguousarray(values)))

    def _tensor(self, values: Any) -> Any:
        return self._o3d.core.Tensor(np.asarray(values, np.float64))


Fusion = _Voxels | _Tsdf


class _Blocks:
    """Points of a cloud by cubes of the world: a view takes only the cubes that the camera sees."""

    def __init__(self, cloud: PointCloud, counts: np.ndarray, side: float) -> None:
        self.cloud, self.counts, self._side = cloud, counts, side
        numbers = cell_numbers(cloud.points, side)
        self._order = np.argsort(numbers, kind="stable")
        found, begins = np.unique(numbers[self._order], return_index=True)
        self._centers, self._parts = cell_centers(found, side), np.split(self._order, begins[1:])

    def before(self, T_world_camera: np.ndarray, pinhole: Pinhole, config: VoxelConfig) -> np.ndarray:
        """Rows, ascending, of the cubes whose bounding sphere meets the camera's frustum."""
        radius = 0.5 * np.sqrt(3.0) * self._side + np.sqrt(2.0) * config.voxel_m
        centers = rotated(self._centers - T_world_camera[:3, 3], T_world_camera[:3, :3].T)
        is_near = centers[:, 2] > -radius
        fx, fy, cx, cy = pinhole.intrinsics
        margin = config.max_footprint_px + 1.0
        for axis, focal, center, size in ((0, fx, cx, pinhole.width), (1, fy, cy, pinhole.height)):
            # Planes through the camera, along the sides of the image.
            for end, sign in ((-margin - center, 1.0), (size + margin - center, -1.0)):
                inside = sign * (focal * centers[:, axis] - end * centers[:, 2])
                is_near &= inside >= -radius * np.hypot(focal, end)
        return np.sort(np.concatenate([np.empty(0, np.int64), *(self._parts[i] for i in np.flatnonzero(is_near))]))


def draw_voxels(
    cloud: PointCloud, counts: np.ndarray, T_world_camera: np.ndarray, pinhole: Pinhole, config: VoxelConfig
) -> Image:
    """Draw averaged points as squares parallel to the image, as large as their voxel; `counts` (n,) are their points.

    The voxels of a pixel form one surface until one lies farther behind the one before than `surface_depth` times its
    depth. The first surface with `min_points` points is drawn at their median depth, else the one with most points: the
    nearest voxel would be the nearest error of all frames. A square reaches ceil(half the side) pixels to each side of
    the point's pixel, as the point may lie anywhere in its voxel.
    """
    fx, fy, cx, cy = pinhole.intrinsics
    points = rotated(cloud.points - T_world_camera[:3, 3], T_world_camera[:3, :3].T)
    z = np.where(points[:, 2] > 0, points[:, 2], 1.0)
    u, v = fx * points[:, 0] / z + cx, fy * points[:, 1] / z + cy
    reach = np.ceil(np.clip(0.5 * config.voxel_m * max(fx, fy) / z, 0.0, config.max_footprint_px))
    inside = (u > -reach - 0.5) & (u < pinhole.width + reach) & (v > -reach - 0.5) & (v < pinhole.height + reach)
    rows = np.flatnonzero((points[:, 2] > 0) & inside)
    rows = rows[np.argsort(z[rows], kind="stable")]
    u, v, reach = (np.rint(values[rows]).astype(np.int64) for values in (u, v, reach))
    covered = []  # pixel times the number of rows, plus row: sorted, they are by pixel and from near to far
    for ring in range(int(reach.max(initial=0)) + 1):  # squares round the own pixels, from there outwards
        order = np.flatnonzero(reach >= ring)
        steps = range(-ring, ring + 1)
        for dy, dx in ((dy, dx) for dy in steps for dx in steps if max(abs(dy), abs(dx)) == ring):
            y, x = v[order] + dy, u[order] + dx
            drawn = (y >= 0) & (y < pinhole.height) & (x >= 0) & (x < pinhole.width)
            covered.append((y[drawn] * pinhole.width + x[drawn]) * len(rows) + order[drawn])
    depth, colors = _nothing(pinhole)
    if not any(map(len, covered)):
        return depth, colors
    pixel, which = np.divmod(np.sort(np.concatenate(covered)), len(rows))
    which = rows[which]
    seen, middle = _front(pixel, z[which], counts[which], config)
    depth.reshape(-1)[seen], colors.reshape(-1, 3)[seen] = z[which[middle]], cloud.colors[which[middle]]
    return depth, colors


def _front(
    pixel: np.ndarray, depth: np.ndarray, counts: np.ndarray, config: VoxelConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Each covered pixel, and the row of its front surface's median point; rows go by pixel and from near to far."""
    is_next = pixel[1:] == pixel[:-1]
    begins = np.concatenate([[True], ~is_next | (np.diff(depth) > config.surface_depth * depth[:-1])])
    first = np.flatnonzero(begins)  # rows of surfaces
    sizes = np.add.reduceat(counts, first)
    owner = pixel[first]
    order = np.lexsort((-np.minimum(sizes, config.min_points), owner))  # stable: of equals the nearest comes first
    shown = order[np.unique(owner[order], return_index=True)[1]]
    upto = np.cumsum(counts)
    middle = np.searchsorted(upto, upto[first[shown]] - counts[first[shown]] + 0.5 * sizes[shown])
    return owner[shown], middle


def _nothing(pinhole: Pinhole) -> Image:
    return np.zeros((pinhole.height, pinhole.width)), np.zeros((pinhole.height, pinhole.width, 3))

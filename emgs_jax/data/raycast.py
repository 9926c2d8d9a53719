"""Common part of the built-in scenes: frames with exact depth, labels and normals, cast from meshes at given poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import open3d as o3d
import trimesh
from jaxtyping import Float, Float32

from emgs_jax.data import reading
from emgs_jax.data.base import STAYS, Dataset, Frame
from emgs_jax.data.furniture import Part
from emgs_jax.data.looks import Looks, draw_looks, paint
from emgs_jax.data.movers import Lane, Mover, build_movers
from emgs_jax.data.reading import Number

FOCAL_PER_WIDTH = 0.82  # 63 degrees across, as a Kinect


@dataclass(frozen=True)
class Scene:
    """Objects in the world, z up, metres: class and mesh of each, and the look in the same row."""

    parts: list[Part]
    looks: Looks


@dataclass(eq=False)
class RayCast(Dataset):
    """A data set whose frames are cast when they are asked for: each depends on its pose only, not on those before.

    A built-in scene is a subclass that names itself, its classes and its version, and says what to `_show`.
    """

    seed: int = 0  # of all that is drawn, 0 or more
    num_frames: int | None = None  # images along the path, which stays the same: more frames are nearer to each other
    # start, stop, stride: which of these images are in use
    start: int = 0
    stop: int | None = None
    stride: int = 1
    size: Sequence[int] = (320, 240)  # (width, height)
    intrinsics: Sequence[Number] | None = None  # fx, fy, cx, cy at `size`; None = .82 times the width and the centre
    movers: int = 0  # how many things move, see `build_movers`

    name: ClassVar[str]
    classes: ClassVar[tuple[str, ...]]
    # Goes up with every change of geometry, texture or path: recorded predictions then no longer fit.
    version: ClassVar[int]
    has_ground_truth = True

    def __post_init__(self) -> None:
        if self.seed < 0 or self.movers < 0 or (self.num_frames is not None and self.num_frames < 1):
            raise ValueError(
                "dataset.seed must be 0 or more (dataset.movers likewise) and dataset.num_frames 1 or more, got "
                f"{self.seed}, {self.movers}, {self.num_frames}"
            )

    def _things(self, lane: Lane) -> list[Mover]:
        return build_movers(self.movers, lane, np.random.default_rng((self.seed, 1)))

    def _show(
        self, sequence: str, scene: Scene, poses: Float[np.ndarray, "n 4 4"], movers: Sequence[Mover] = ()
    ) -> None:
        """Set what is cast.

        Args:
            sequence: name of the scene and of the path through it.
            scene: what the rays meet; it must enclose all poses.
            poses: T_world_camera of all images along the path.
            movers: what moves in it, with a place for each image along the path.
        """
        self._numbers = reading.select(len(poses), self.start, self.stop, self.stride, f"{self.name} {sequence}")
        self.sequence, self.parts, self._looks, self._poses = sequence, scene.parts, scene.looks, poses
        self.size = w, h = reading.check_size(self.size)
        default = (FOCAL_PER_WIDTH * w, FOCAL_PER_WIDTH * w, (w - 1) / 2, (h - 1) / 2)
        given = default if self.intrinsics is None else self.intrinsics
        self.intrinsics = reading.check_intrinsics(given, self.size)
        self.calibration = {"source": "rendered", "size": [w, h], "intrinsics": [*self.intrinsics], "distortion": []}
        moving = [mover.part for mover in movers]
        self._movers, self._moving_looks = movers, draw_looks(moving, np.random.default_rng(len(moving)))
        self.classes = (*self.classes, *dict.fromkeys(name for name, _ in moving if name not in self.classes))
        self._labels = np.array([self.classes.index(name) for name, _ in [*self.parts, *moving]], np.int32)
        self._scene = _scene([mesh for _, mesh in self.parts])

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, index: int) -> Frame:
        depth, objects, normals, rays = self._cast(index)
        number, first = self._numbers[index], len(self.parts)
        points = self._poses[number][:3, 3] + rays[..., 3:] * depth[..., None]
        is_static = objects < first
        image = np.zeros(points.shape, np.uint8)
        image[is_static] = paint(points[is_static], normals[is_static], objects[is_static], self._looks)
        moving = np.full(objects.shape, STAYS, np.uint8) if self._movers else None
        for row, mover in enumerate(self._movers):
            here, T_mover_world = objects == first + row, np.linalg.inv(mover.poses[number])
            own = points[here] @ T_mover_world[:3, :3].T + T_mover_world[:3, 3]  # its pattern goes with it
            image[here] = paint(own, normals[here], objects[here] - first, self._moving_looks)
            moving[here] = mover.states[number]
        name = f"{self.name} {self.sequence}, frame {number}"
        return Frame(index, float(number), name, image, depth, self.pose(index), self._labels[objects], moving)

    def pose(self, index: int) -> Float[np.ndarray, "4 4"]:
        return self._poses[self._numbers[index]].copy()

    def normals(self, index: int) -> Float32[np.ndarray, "h w 3"]:
        """Unit normals of the surfaces in the camera's axes, facing the camera."""
        _, _, normals, rays = self._cast(index)
        normals = np.where((normals * rays[..., 3:]).sum(-1, keepdims=True) > 0, -normals, normals)
        return np.einsum("hwj,ji->hwi", normals, self._poses[self._numbers[index]][:3, :3].astype(np.float32))

    def _cast(self, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Depth (h, w), object (h, w), normal in the world (h, w, 3) and ray (origin, direction) (h, w, 6)."""
        reading.check_index(index, len(self))
        (w, h), (fx, fy, cx, cy) = self.size, self.intrinsics
        pose = self._poses[self._numbers[index]]
        u, v = np.meshgrid((np.arange(w) - cx) / fx, (np.arange(h) - cy) / fy)
        # In the camera a direction's z is 1, so the hit's parameter is the depth.
        directions = np.einsum("hwj,ij->hwi", np.stack([u, v, np.ones_like(u)], axis=-1), pose[:3, :3])
        rays = np.concatenate([np.broadcast_to(pose[:3, 3], directions.shape), directions], axis=-1).astype(np.float32)
        depth, objects, normals = _first_hits(self._scene, rays)
        if self._movers:
            number = self._numbers[index]
            meshes = [mover.part[1].copy().apply_transform(mover.poses[number]) for mover in self._movers]
            near, rows, facing = _first_hits(_scene(meshes), rays)
            is_hidden = near < depth
            depth, objects = np.where(is_hidden, near, depth), np.where(is_hidden, len(self.parts) + rows, objects)
            normals = np.where(is_hidden[..., None], facing, normals)
        return depth, objects, normals, rays

    def files(self, index: int) -> tuple[()]:
        return ()

    def fingerprint(self) -> str:
        options = {
            "dataset": self.name,
            "version": self.version,
            "sequence": self.sequence,
            "poses": len(self._poses),
            "frames": (self._numbers.start, self._numbers.stop, self._numbers.step),
            "size": self.size,
            "intrinsics": self.intrinsics,
        }
        options |= {"movers": len(self._movers)} if self._movers else {}
        return reading.fingerprint(Path(), (), options)


def _scene(meshes: Sequence[trimesh.Trimesh]) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    for mesh in meshes:
        vertices, faces = np.array(mesh.vertices, np.float32), np.array(mesh.faces, np.uint32)
        scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(faces))
    return scene


def _first_hits(
    scene: o3d.t.geometry.RaycastingScene, rays: Float32[np.ndarray, "h w 6"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth (infinite where there is none), object and normal where each ray ends."""
    hit = scene.cast_rays(o3d.core.Tensor(rays))
    return hit["t_hit"].numpy(), hit["geometry_ids"].numpy().astype(np.int64), hit["primitive_normals"].numpy()


def level_poses(
    positions: Float[np.ndarray, "n 3"], yaw: Float[np.ndarray, " n"], pitch: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 4 4"]:
    """T_world_camera without roll, OpenCV axes; yaw from the world's x about z, pitch up, in radians."""
    forward = np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], axis=-1)
    right = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], axis=-1)
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    poses[:, :3, 3] = positions
    return poses

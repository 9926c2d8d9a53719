"""Common part of the built-in scenes: frames with exact depth, labels and normals, cast from meshes at given poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d
from jaxtyping import Float, Float32

from emgs_jax.data import reading
from emgs_jax.data.base import Frame
from emgs_jax.data.furniture import Part
from emgs_jax.data.looks import Looks, paint
from emgs_jax.data.reading import Number

FOCAL_PER_WIDTH = 0.82  # 63 degrees across, as a Kinect


@dataclass(frozen=True)
class Scene:
    """Objects in the world, z up, metres: class and mesh of each, and the look in the same row."""

    parts: list[Part]
    looks: Looks


class RayCast:
    """A data set whose frames are cast when they are asked for: each depends on its pose only, not on those before.

    A built-in scene is a subclass that names itself, its classes and its version, and builds what follows.

    Args:
        sequence: name of the scene and of the path through it.
        scene: what the rays meet; it must enclose all poses.
        poses: T_world_camera of all images along the path.
        numbers: which of these images are in use.
        size: (width, height).
        intrinsics: fx, fy, cx, cy at `size`; None = .82 times the width and the centre.
    """

    name: str
    classes: tuple[str, ...]
    version: int  # goes up with every change of geometry, texture or path: recorded predictions then no longer fit
    has_ground_truth = True

    def __init__(
        self,
        sequence: str,
        scene: Scene,
        poses: Float[np.ndarray, "n 4 4"],
        numbers: range,
        size: Sequence[int],
        intrinsics: Sequence[Number] | None,
    ) -> None:
        self.sequence, self.parts = sequence, scene.parts
        self._looks, self._poses, self._numbers = scene.looks, poses, numbers
        self.size = reading.check_size(size)
        w, h = self.size
        default = (FOCAL_PER_WIDTH * w, FOCAL_PER_WIDTH * w, (w - 1) / 2, (h - 1) / 2)
        self.intrinsics = reading.check_intrinsics(default if intrinsics is None else intrinsics, self.size)
        self.calibration = {"source": "rendered", "size": [w, h], "intrinsics": [*self.intrinsics], "distortion": []}
        self._labels = np.array([self.classes.index(name) for name, _ in self.parts], np.int32)
        self._scene = o3d.t.geometry.RaycastingScene()
        for _, mesh in self.parts:
            vertices, faces = np.array(mesh.vertices, np.float32), np.array(mesh.faces, np.uint32)
            self._scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(faces))

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, index: int) -> Frame:
        depth, objects, normals, rays = self._cast(index)
        pose = self._poses[self._numbers[index]]
        points = pose[:3, 3] + rays.reshape(-1, 6)[:, 3:] * depth.reshape(-1, 1)
        image = paint(points, normals.reshape(-1, 3), objects.reshape(-1), self._looks)
        number = self._numbers[index]
        name = f"{self.name} {self.sequence}, frame {number}"
        return Frame(
            index, float(number), name, image.reshape(*depth.shape, 3), depth, self.pose(index), self._labels[objects]
        )

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
        hit = self._scene.cast_rays(o3d.core.Tensor(rays))
        objects = hit["geometry_ids"].numpy().astype(np.int64)
        return hit["t_hit"].numpy(), objects, hit["primitive_normals"].numpy(), rays

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
        return reading.fingerprint(Path(), (), options)


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

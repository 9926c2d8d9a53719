"""A furnished room, ray-cast: images with exact depth, poses, labels and normals, from nothing but a seed."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import open3d as o3d
from jaxtyping import Float, Float32

from emgs_jax.data import reading, room
from emgs_jax.data.base import Frame
from emgs_jax.data.reading import Number

VERSION = 1  # goes up with every change of geometry, texture or path: recorded predictions then no longer fit
FOCAL_PER_WIDTH = 0.82  # 63 degrees across, as a Kinect
ARC = np.radians(140.0)  # of the round that the camera goes


class Synthetic:
    """The camera goes round the middle of a room and looks across it: about 6.5 cm and 3.6 degrees a frame of 40.

    Args:
        seed: room, furniture, colours and path.
        num_frames: images along the path, which stays the same: more frames are nearer to each other.
        start, stop, stride: which of these images.
        size: (width, height).
        intrinsics: fx, fy, cx, cy at `size`; None = .82 times the width and the centre.
    """

    name = "synthetic"
    classes = room.CLASSES
    has_ground_truth = True

    def __init__(
        self,
        seed: int = 0,
        num_frames: int = 40,
        start: int = 0,
        stop: int | None = None,
        stride: int = 1,
        size: Sequence[int] = (320, 240),
        intrinsics: Sequence[Number] | None = None,
    ) -> None:
        if seed < 0 or num_frames < 1:
            raise ValueError(
                f"dataset.seed must be 0 or more and dataset.num_frames 1 or more, got {seed}, {num_frames}"
            )
        self.sequence = f"room{seed}"
        self._numbers = reading.select(num_frames, start, stop, stride, f"{self.name} {self.sequence}")
        self.size = reading.check_size(size)
        w, h = self.size
        default = (FOCAL_PER_WIDTH * w, FOCAL_PER_WIDTH * w, (w - 1) / 2, (h - 1) / 2)
        self.intrinsics = reading.check_intrinsics(default if intrinsics is None else intrinsics, self.size)
        self.calibration = {"source": "rendered", "size": [w, h], "intrinsics": [*self.intrinsics], "distortion": []}
        rng = np.random.default_rng(seed)
        self.parts, room_size = room.build_room(rng)  # (class, mesh in the world) of every object
        self._labels = np.array([self.classes.index(name) for name, _ in self.parts], np.int32)
        self._looks = room.draw_looks(self.parts, rng)
        self._poses = camera_path(num_frames, room_size, rng)
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
        image = room.paint(points, normals.reshape(-1, 3), objects.reshape(-1), self._looks)
        number = self._numbers[index]
        name = f"{self.name} {self.sequence}, frame {number}"
        return Frame(
            index, float(number), name, image.reshape(*depth.shape, 3), depth, pose.copy(), self._labels[objects]
        )

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

    def fingerprint(self) -> str:
        options = {
            "dataset": self.name,
            "version": VERSION,
            "sequence": self.sequence,
            "poses": len(self._poses),
            "frames": (self._numbers.start, self._numbers.stop, self._numbers.step),
            "size": self.size,
            "intrinsics": self.intrinsics,
        }
        return reading.fingerprint(Path(), (), options)


def camera_path(
    num_frames: int, room_size: Float[np.ndarray, " 3"], rng: np.random.Generator
) -> Float[np.ndarray, "n 4 4"]:
    """T_world_camera along an arc above the furniture, looking inward and a little down, without roll."""
    begin, sense, phase = rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0]), rng.uniform(0, 2 * np.pi)
    round_ = np.linspace(0, ARC, num_frames)
    angle = begin + sense * round_
    a, b = room_size[0] / 2 - 1.25, room_size[1] / 2 - 1.05
    height = 1.5 + 0.06 * np.sin(2 * round_ + phase)
    positions = np.stack([a * np.cos(angle), b * np.sin(angle), height], axis=-1)
    yaw = angle + np.pi + np.radians(5) * np.sin(2 * round_ + phase)
    pitch = np.radians(-16) + np.radians(4) * np.sin(3 * round_ + phase)
    forward = np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], axis=-1)
    right = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], axis=-1)
    poses = np.tile(np.eye(4), (num_frames, 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    poses[:, :3, 3] = positions
    return poses

"""An object with the documented contract of MapAnything's `infer`, which draws geometry that is known in closed form.

It refuses what the real model refuses, ignores the value of the anchor's pose, answers in the frame of view 0 with a
pose of view 0 that is only nearly the identity, and spoils the dicts it was given.
"""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.data.base import Frame
from emgs_jax.prior.network.framework import DEVIATION, MEAN, NORM, PATCH

KEYS = {"img", "data_norm_type", "intrinsics", "camera_poses", "is_metric_scale"}


def rigid(rotation, translation):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rotation).as_matrix(), translation
    return T


NEARLY_IDENTITY = rigid((0.02, -0.03, 0.01), (0.03, -0.02, 0.04))


class Sphere:
    """A data set seen from inside a sphere; every image has one colour, which is its number."""

    name, sequence, classes, has_ground_truth = "sphere", "one", (), True
    radius, center = 3.0, np.array([1.0, 2.0, 0.5])

    def __init__(self, num_frames=5, size=(40, 30)):
        self.num_frames, self.size = num_frames, size
        self.intrinsics = (0.9 * size[0], 0.85 * size[0], 0.48 * size[0], 0.53 * size[1])

    def __len__(self):
        return self.num_frames

    def pose(self, index):
        return rigid((0.1, 0.3 + 0.1 * index, 0.2), (0.5 + 0.2 * index, 2.1, 0.3 - 0.1 * index))

    def __getitem__(self, index):
        image = np.full((*self.size[::-1], 3), index, np.uint8)
        return Frame(index, float(index), f"{index}.png", image, None, self.pose(index))

    def fingerprint(self):
        return f"{self.num_frames} {self.size}"

    def which(self, image):
        """Number of the frame that an image, RGB in [0, 1], is of."""
        return round(float(image.mean()) * 255)

    def depth(self, index, intrinsics, size):
        """Depth (h, w) of the sphere at a grid: the positive root of |o + z d - c|² = r²."""
        v, u = np.indices(size[::-1])
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(intrinsics).T @ self.pose(index)[:3, :3].T
        offset = self.pose(index)[:3, 3] - self.center
        a, b, c = (rays**2).sum(-1), rays @ offset, offset @ offset - self.radius**2
        return (np.sqrt(b**2 - a * c) - b) / a


class Double:
    """See the module.

    Args:
        scene: `which`, `pose` and `depth` as in `Sphere`.
        convert: from arrays to what it gives out.
        spoil: changes the outputs of one view in place.
    """

    def __init__(self, scene, convert: Callable = np.asarray, spoil: Callable = lambda index, output: None):
        self._scene, self._convert, self._spoil = scene, convert, spoil
        self.seen = []  # keys of every view of the last call

    def infer(
        self,
        views,
        memory_efficient_inference=True,
        minibatch_size=None,
        use_amp=True,
        amp_dtype="bf16",
        apply_mask=True,
    ):
        assert not apply_mask, "this double gives no masks"
        if use_amp:
            raise RuntimeError("Index put requires the source and destination dtypes match")  # as on a CPU
        check_views(views)
        self.seen = [set(view) for view in views]
        images = [self._image(view) for view in views]
        numbers = [self._scene.which(image) for image in images]
        poses = [NEARLY_IDENTITY @ np.linalg.inv(self._scene.pose(numbers[0])) @ self._scene.pose(n) for n in numbers]
        unit = 1.05 if "camera_poses" in views[0] else 1.0
        if np.asarray(views[0].get("is_metric_scale", True)).all():
            unit *= 1.1  # its features differ
        outputs = []
        for view, number, image, T in zip(views, numbers, images, poses, strict=True):
            height, width = image.shape[:2]
            K = np.asarray(view["intrinsics"])[0]
            outputs.append(self._output(number, K, (width, height), T, unit))
            for key in view:
                view[key] = None
        return outputs

    def _image(self, view):
        return (np.asarray(view["img"])[0] * DEVIATION + MEAN).transpose(1, 2, 0)

    def _output(self, number, intrinsics, size, T, unit):
        depth = unit * self._scene.depth(number, intrinsics.astype(float), size)
        v, u = np.indices(depth.shape)
        points = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(intrinsics.astype(float)).T
        points = points * depth[..., None]
        T = T.copy()
        T[:3, 3] *= unit
        output = {
            "pts3d_cam": points[None].astype(np.float32),
            "depth_z": depth[None, ..., None].astype(np.float32),
            "intrinsics": intrinsics[None].astype(np.float32),
            "camera_poses": T[None].astype(np.float32),
            "conf": (1 + u + v)[None].astype(np.float32),
            "non_ambiguous_mask": np.ones((1, *depth.shape), bool),
        }
        self._spoil(number, output)
        return {key: self._convert(value) for key, value in output.items()}


def check_views(views):
    """Raise what the real model raises for views that break its contract (part A.5 of the reference)."""
    for number, view in enumerate(views):
        if set(view) - KEYS:
            raise ValueError(f"View {number} contains invalid keys: {set(view) - KEYS}")
        if not {"img", "data_norm_type"} <= set(view):
            raise ValueError(f"View {number} missing required keys")
        assert view["data_norm_type"] == [NORM]
        height, width = view["img"].shape[2:]
        assert height % PATCH == 0 and width % PATCH == 0, (
            f"Input shape must be divisible by patch size: {height, width}"
        )
        if tuple(view["img"].shape) != tuple(views[0]["img"].shape):
            raise RuntimeError("stack expects each tensor to be equal size")
        for key in ("img", "intrinsics"):
            if key in view and np.asarray(view[key]).dtype != np.float32:
                raise RuntimeError(f"Index put requires the source and destination dtypes match ({key})")
        if "intrinsics" in view:
            assert view["intrinsics"].shape == (1, 3, 3)
    if any("camera_poses" in view for view in views) and "camera_poses" not in views[0]:
        raise ValueError("Camera pose constraint violation: view 0 (reference view) has none")


def network_of(double: Double) -> SimpleNamespace:
    """The double as a `Network` without torch."""
    return SimpleNamespace(
        infer=lambda views: double.infer(views, use_amp=False, apply_mask=False),
        described={"device": "double"},
        peak_bytes=3 * 2**20,
    )

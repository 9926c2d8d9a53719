"""Initial splats on the surface that the map shows in the frames, in the colours of their images."""

from collections.abc import Callable, Sequence

import cv2
import jax.numpy as jnp
import numpy as np

from emgs_jax.ops.camera import Camera
from emgs_jax.polish.splats import Anchors

SAME_SURFACE = 0.05  # of the depth; a splat this near to the map's surface covers it
STEEPEST = 0.3  # cosine; surface at a more grazing angle is left to frames that see it from the front


class Seeds:
    """Splats on the surface that frames see, one for `pixels_per_splat` pixels of the frame that shows it largest.

    A frame makes none at a grazing angle or beside the silhouette of something nearer. There its image shows what is
    behind, and the splat would be a long streak across what others see from the front.
    """

    def __init__(self, camera: Camera, pixels_per_splat: int) -> None:
        self._camera, self._spacing = camera, float(np.sqrt(pixels_per_splat))
        self._rows: list[tuple[np.ndarray, ...]] = []  # means, colours, axes, std of every frame that adds some

    def add(self, view, image: np.ndarray, pose: np.ndarray) -> None:
        """Add a splat to every empty cell of a frame in which it sees the surface well enough.

        Args:
            view: `DenseView` of the map at the frame.
            image: RGB in [0, 1], (h, w, 3).
            pose: T_world_camera.
        """
        height, width = image.shape[:2]
        counts = [int(np.ceil(side / self._spacing)) for side in (height, width)]
        y, x = (
            np.minimum(((np.arange(n) + 0.5) * self._spacing).astype(int), side - 1)
            for n, side in zip(counts, (height, width), strict=True)
        )
        is_free = view.valid[np.ix_(y, x)] & ~self._held(view, pose, counts) & ~_at_edge(view.depth)[np.ix_(y, x)]
        y, x = y[np.nonzero(is_free)[0]], x[np.nonzero(is_free)[1]]
        points, normals = (np.asarray(values[y, x], np.float64) for values in (view.points, view.normals))
        rays = points - pose[:3, 3]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        cosine = -np.einsum("ni,ni->n", rays, normals)
        is_frontal = cosine >= STEEPEST
        y, x, points, normals, rays, cosine = (v[is_frontal] for v in (y, x, points, normals, rays, cosine))
        along = rays + cosine[:, None] * normals + 1e-6 * pose[:3, 0]  # direction of foreshortening
        along -= np.einsum("ni,ni->n", along, normals)[:, None] * normals
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        axes = np.stack([along, np.cross(normals, along), normals], axis=2)
        std = 0.5 * self._spacing * view.depth[y, x] / float(np.mean(np.asarray(self._camera.focal)))
        std = np.stack([std / cosine, std], axis=1)
        self._rows.append((points, image[y, x], axes, std))

    def _held(self, view, pose: np.ndarray, counts: Sequence[int]) -> np.ndarray:
        """Mark the frame's cells that already hold a splat on the surface that the map shows there."""
        held, (height, width) = np.zeros(counts, bool), view.depth.shape
        for means, *_ in self._rows:
            local = (means - pose[:3, 3]) @ pose[:3, :3]
            z = np.where(local[:, 2] > 0, local[:, 2], 1.0)
            u, v = (local[:, :2] / z[:, None] * np.asarray(self._camera.focal) + np.asarray(self._camera.center)).T
            inside = (local[:, 2] > 0) & (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5)
            u, v, z = u[inside], v[inside], z[inside]
            near = np.abs(view.depth[np.rint(v).astype(int), np.rint(u).astype(int)] - z) < SAME_SURFACE * z
            cells = (np.clip(values[near] + 0.5, 0, None) / self._spacing for values in (v, u))
            held[tuple(np.minimum(cell.astype(int), n - 1) for cell, n in zip(cells, counts, strict=True))] = True
        return held

    def anchors(self, noise: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> tuple[Anchors, np.ndarray]:
        """Return all splats as anchors, and their colours; `noise(means, normals)` is the map's, m."""
        means, colors, axes, std = (np.concatenate(column) for column in zip(*self._rows, strict=True))
        values = means, axes, std, noise(means, axes[..., 2])
        return Anchors(*(jnp.asarray(value, jnp.float32) for value in values)), colors


def _at_edge(depth: np.ndarray) -> np.ndarray:
    """Mark pixels beside a jump of the map's depth, where an image may show what is behind."""
    low, high = (change(depth, np.ones((3, 3), np.uint8)) for change in (cv2.erode, cv2.dilate))
    return high - low > SAME_SURFACE * depth

"""Similarities and rigid poses on the host: float64 matrices, poses are (..., 4, 4) from the camera to the world."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Sim3:
    """Similarity that maps one world to another: y = scale · rotation @ x + translation."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    @classmethod
    def about(cls, center: Float[np.ndarray, "3"], scale: float) -> "Sim3":
        """Scale all lengths about a point, which stays in place."""
        return cls(scale, np.eye(3), center - scale * center)

    @classmethod
    def from_matrix(cls, matrix: Float[np.ndarray, "4 4"]) -> "Sim3":
        """Read a (4, 4) matrix with scale · rotation in place of the rotation."""
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        return cls(scale, matrix[:3, :3] / scale, matrix[:3, 3])

    def as_matrix(self) -> Float[np.ndarray, "4 4"]:
        """Return the matrix that `from_matrix` reads."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.scale * self.rotation, self.translation
        return matrix

    def apply(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Map points."""
        return rotated(self.scale * points, self.rotation) + self.translation

    def apply_to_poses(self, poses: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 4 4"]:
        """Map camera poses; they stay rigid, and the scale acts on their positions only."""
        moved = np.array(poses, np.float64)
        moved[..., :3, :3] = self.rotation @ moved[..., :3, :3]
        moved[..., :3, 3] = self.apply(moved[..., :3, 3])
        return moved

    def __matmul__(self, other: "Sim3") -> "Sim3":
        """Compose: `other` first."""
        return Sim3(self.scale * other.scale, self.rotation @ other.rotation, self.apply(other.translation))

    def inverse(self) -> "Sim3":
        """Map back."""
        rotation = self.rotation.T
        return Sim3(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)


def nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation R with the largest trace of Rᵀ · matrix, never a reflection."""
    U, _, Vt = np.linalg.svd(matrix)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt


def similarity_of(
    x: Float[np.ndarray, "n 3"],
    y: Float[np.ndarray, "n 3"],
    rotation: Float[np.ndarray, "3 3"] | None = None,
    with_scale: bool = True,
) -> Sim3:
    """Return the least-squares similarity from points x to y (Umeyama 1991), of a given rotation or scale 1.

    Points along a line leave the turn about it open; to find a scale, x must differ.
    """
    covariance = (y - y.mean(0)).T @ (x - x.mean(0))
    rotation = nearest_rotation(covariance) if rotation is None else rotation
    scale = float(np.trace(rotation.T @ covariance) / np.sum((x - x.mean(0)) ** 2)) if with_scale else 1.0
    return Sim3(scale, rotation, y.mean(0) - scale * rotation @ x.mean(0))


def rotated(vectors: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Rotate each vector (..., 3). Not by BLAS, whose threads wait longer than so small a product takes."""
    return np.einsum("ij,...j->...i", rotation, vectors)


def scale_covariance(covariance: np.ndarray, scale: float) -> np.ndarray:
    """Convert a covariance of (translation, rotation, ...), (..., d, d), after lengths are multiplied by `scale`."""
    units = np.ones(covariance.shape[-1])
    units[:3] = scale
    return units[:, None] * covariance * units


def adjoint(T: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 6 6"]:
    """Compute the adjoint of poses: T Exp(xi) = Exp(Ad xi) T, translation first."""
    rotations, across = T[:, :3, :3], np.cross(T[:, None, :3, 3], T[:, :3, :3], axisb=1, axisc=1)
    return np.block([[rotations, across], [np.zeros_like(rotations), rotations]])


def seen_from(
    covariance: Float[np.ndarray, "6 6"], T_world_there: Float[np.ndarray, "4 4"], T_world: Float[np.ndarray, "n 4 4"]
) -> Float[np.ndarray, "n 6 6"]:
    """Carry a pose's covariance to others that move with it as one rigid body: Ad Σ Adᵀ, each in its own axes."""
    adjoints = adjoint(np.linalg.inv(T_world) @ T_world_there)
    return adjoints @ covariance @ adjoints.transpose(0, 2, 1)


def scale_pose(T: Float[np.ndarray, "4 4"], scale: float) -> Float[np.ndarray, "4 4"]:
    """Multiply the translation of a pose by `scale`."""
    return np.block([[T[:3, :3], scale * T[:3, 3:]], [T[3:]]])


def transform_points(T: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Map points by a pose."""
    return points @ T[:3, :3].T + T[:3, 3]


def pose_difference(
    T: Float[np.ndarray, "*n 4 4"], other: Float[np.ndarray, "*n 4 4"]
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Compute the distance of two camera centres and the angle between the cameras in degrees; for one pair or n."""
    angle = Rotation.from_matrix(T[..., :3, :3].mT @ other[..., :3, :3]).magnitude()
    return np.linalg.norm(T[..., :3, 3] - other[..., :3, 3], axis=-1), np.degrees(angle)

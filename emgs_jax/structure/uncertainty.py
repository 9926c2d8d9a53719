"""Covariances of a model's poses, from the Hessian of its bundle adjustment.

COLMAP's tangent of a pose (R, t), camera from world, is z = (q, b): R' = Exp(2 q) R, t' = t + b. Ours is xi of the
inverse, T_world_camera Exp(xi), translation first: xi = (-b - t x 2 q, -2 q).
"""

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float

from emgs_jax.structure.library import load

NUM_REFERENCES = 32  # frames that determine the unit


def camera_in_world(image: Any) -> Float[np.ndarray, "4 4"]:
    """T_world_camera of an image of pycolmap."""
    return np.vstack([image.cam_from_world().inverse().matrix(), (0, 0, 0, 1)])


def covariances(model: Any, images: Mapping[int, Any], pixel_std: float) -> dict[int, Float[np.ndarray, "6 6"]]:
    """Covariance of xi of each image's pose relative to the first's, for the unit that fits all of them best.

    Poses and points are free, up to three points that are held. That leaves a common factor of all lengths, which is no
    error of a pose: the factor s = sum(w_r xi_r) that some of the frames agree on is taken out, xi_i - g_i s with g_i
    the change of xi_i by log s. Residuals have the standard deviation that they show, or `pixel_std` if that is larger.

    Args:
        images: by frame, in order. Frames whose covariance cannot be found are left out.
    """
    joint = _joint(model, images)
    frames = [] if joint is None else [frame for frame in images if joint(frame, frame) is not None]
    if len(frames) < 3:
        return {}
    T = {frame: camera_in_world(images[frame]) for frame in frames}
    first, references = frames[0], [frames[row] for row in _spread(len(frames), NUM_REFERENCES)]
    relative = {frame: np.linalg.inv(T[first]) @ T[frame] for frame in frames}
    own = {frame: _to_xi(np.linalg.inv(T[frame])) for frame in frames}
    of_first = {frame: -adjoint(np.linalg.inv(relative[frame])) @ own[first] for frame in frames}
    unit = {frame: np.append(relative[frame][:3, :3].T @ relative[frame][:3, 3], np.zeros(3)) for frame in frames}
    total = sum(unit[frame] @ unit[frame] for frame in references)

    def between(a: int, b: int) -> np.ndarray:
        """Covariance (6, 6) of xi of two frames relative to the first."""
        return (
            own[a] @ joint(a, b) @ own[b].T
            + own[a] @ joint(a, first) @ of_first[b].T
            + of_first[a] @ joint(first, b) @ own[b].T
            + of_first[a] @ joint(first, first) @ of_first[b].T
        )

    def with_unit(frame: int) -> np.ndarray:
        return sum(between(frame, other) @ unit[other] for other in references) / total

    of_unit = {frame: with_unit(frame) for frame in frames[1:]}
    variance = sum(unit[frame] @ of_unit[frame] for frame in references if frame != first) / total
    scale, found = (
        max(2 / np.pi * model.compute_mean_reprojection_error() ** 2, pixel_std**2),
        {first: np.zeros((6, 6))},
    )
    for frame in frames[1:]:
        mixed = np.outer(of_unit[frame], unit[frame])
        free = between(frame, frame) - mixed - mixed.T + variance * np.outer(unit[frame], unit[frame])
        found[frame] = scale * 0.5 * (free + free.T)
    return found


def _joint(model: Any, images: Mapping[int, Any]) -> Any:
    """A function of two frames: covariance (6, 6) of their z, for residuals of one pixel; None if it is singular."""
    pycolmap = load()
    problem = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        problem.add_image(image)
    for camera in model.cameras:
        problem.set_constant_cam_intrinsics(camera)
    problem.fix_gauge(pycolmap.BundleAdjustmentGauge.THREE_POINTS)
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=False, refine_extra_params=False, print_summary=False
    )
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, problem, model)
    poses = pycolmap.BACovarianceOptions(params=pycolmap.BACovarianceOptionsParams.POSES)
    found = pycolmap.estimate_ba_covariance(poses, model, adjuster)
    if found is None:
        return None

    @cache
    def joint(a: int, b: int) -> np.ndarray:
        if a > b:
            return joint(b, a).T
        return found.get_cam_cross_cov_from_world(images[a].image_id, images[b].image_id)

    return joint


def _spread(count: int, most: int) -> np.ndarray:
    """Rows 1 to count - 1, evenly chosen, `most` at most."""
    return np.unique(np.linspace(1, count - 1, min(count - 1, most)).astype(int))


def _to_xi(T_camera_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6 6"]:
    """Derivative of xi by z."""
    t = T_camera_world[:3, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return np.block([[-2 * cross, -np.eye(3)], [-2 * np.eye(3), np.zeros((3, 3))]])


def adjoint(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6 6"]:
    """Ad of a pose: T Exp(xi) = Exp(Ad xi) T."""
    R, t = T[:3, :3], T[:3, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return np.block([[R, cross @ R], [np.zeros((3, 3)), R]])

"""Covariances of a model's poses, from the Hessian of its bundle adjustment.

COLMAP's tangent of a pose (R, t), camera from world, is z = (q, b): R' = Exp(2 q) R, t' = t + b. Ours is xi of the
inverse, T_world_camera Exp(xi), translation first: xi = (-b - t x 2 q, -2 q).
"""

import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from emgs_jax.geometry import adjoint
from emgs_jax.structure.library import bundle_of, load, options_of

NUM_REFERENCES = 32  # frames that determine the unit
# Frames of a stretch, of which the first were in the one before, too; and its images, not all of which are in use. Time
# grows with the cube of these.
STRETCH, OVERLAP, MOST = 120, 20, 160


def camera_in_world(image: Any) -> Float[np.ndarray, "4 4"]:
    """T_world_camera of an image of pycolmap."""
    return np.vstack([image.cam_from_world().inverse().matrix(), (0, 0, 0, 1)])


def covariances(model: Any, images: Mapping[int, Any], pixel_std: float) -> dict[int, Float[np.ndarray, "6 6"]]:
    """Covariance of xi of each image's pose relative to the pose before it, for the unit that fits all of them best.

    A map is made of the frames before, so an error that they share moves the whole map and does not count: the
    covariance is of the motion T_before_image, whose xi is xi_i - Ad(T_i_before) xi_before. The first pose is held.

    A common factor of all lengths is no error either: the factor s = sum(w_r xi_r) of some of the frames is removed,
    xi_i - g_i s, where g_i is the change of xi_i by log s. The standard deviation of residuals is their own, or
    `pixel_std` if that is larger. Frames without a covariance are left out.

    A large model is taken in stretches, each with the images that show most of its points and with a unit of its own.
    """
    # The mean length of a 2D error of standard deviation s is s sqrt(pi / 2).
    scale = max(2 / np.pi * model.compute_mean_reprojection_error() ** 2, pixel_std**2)
    if model.num_reg_images() <= MOST:
        return _of_stretch(model, images, scale)
    frames, spread = [*images], {}
    for begin in range(0, max(len(frames) - OVERLAP, 1), STRETCH - OVERLAP):
        own = {frame: images[frame] for frame in frames[begin : begin + STRETCH]}
        few = _part(model, [image.image_id for image in own.values()])
        found = _of_stretch(few, {frame: few.images[image.image_id] for frame, image in own.items()}, scale)
        known = {*frames[: begin + OVERLAP // 2]} if begin else set()  # by what is on both sides of them
        spread |= {frame: one for frame, one in found.items() if frame not in known}
    return spread


def _part(model: Any, wanted: Sequence[int]) -> Any:
    """The model of these images and of those that show most of their points, `MOST` in all."""
    points = {p.point3D_id for image in wanted for p in model.images[image].points2D if p.has_point3D()}
    shown = Counter(one.image_id for point in points for one in model.points3D[point].track.elements)
    for image in wanted:
        shown.pop(image, None)
    kept = {*wanted, *(image for image, _ in shown.most_common(max(MOST - len(wanted), 0)))}
    frames = {model.images[image].frame_id for image in kept}
    found = load().Reconstruction(model)
    for frame in [*found.reg_frame_ids()]:
        if frame not in frames:
            found.deregister_frame(frame)
    with tempfile.TemporaryDirectory() as folder:  # what has no pose is not written, and would end the covariances
        found.write_binary(folder)
        return load().Reconstruction(folder)


def _of_stretch(model: Any, images: Mapping[int, Any], scale: float) -> dict[int, Float[np.ndarray, "6 6"]]:
    """`covariances` of a model as a whole, for this variance of residuals."""
    found = _covariance(model, next(iter(images.values())))
    if found is None:
        return {}
    first, *others = images
    # An image without points is no variable of the problem.
    others = [frame for frame in others if found.get_cam_cov_from_world(images[frame].image_id) is not None]
    frames = [first, *others]
    if len(frames) < 3:
        return {}
    references = [frames[row] for row in _spread(len(frames), NUM_REFERENCES)]
    T = {frame: camera_in_world(images[frame]) for frame in frames}
    to_xi = {frame: _to_xi(np.linalg.inv(T[frame])) for frame in frames}
    relative = {frame: np.linalg.inv(T[first]) @ T[frame] for frame in frames}
    unit = {frame: np.append(relative[frame][:3, :3].T @ relative[frame][:3, 3], np.zeros(3)) for frame in frames}
    total = sum(unit[frame] @ unit[frame] for frame in references)

    def between(a: int, b: int) -> np.ndarray:
        """Covariance (6, 6) of xi of two frames."""
        if first in (a, b):
            return np.zeros((6, 6))
        joint = found.get_cam_cross_cov_from_world(images[a].image_id, images[b].image_id)
        return to_xi[a] @ joint @ to_xi[b].T

    with_unit = {frame: sum(between(frame, other) @ unit[other] for other in references) / total for frame in frames}
    variance = sum(unit[frame] @ with_unit[frame] for frame in references) / total

    def free(a: int, b: int) -> np.ndarray:
        """`between` without the common factor."""
        mixed = np.outer(with_unit[a], unit[b]) + np.outer(unit[a], with_unit[b])
        return between(a, b) - mixed + variance * np.outer(unit[a], unit[b])

    spread = {first: np.zeros((6, 6))}
    for before, frame in pairwise(frames):
        moved = adjoint((np.linalg.inv(T[frame]) @ T[before])[None])[0]
        mixed = moved @ free(before, frame)
        motion = free(frame, frame) - mixed - mixed.T + moved @ free(before, before) @ moved.T
        spread[frame] = scale * 0.5 * (motion + motion.T)
    return {frame: one for frame, one in spread.items() if np.isfinite(one).all()}


def _covariance(model: Any, first: Any) -> Any:
    """pycolmap's covariances of all poses, for residuals of one pixel; None if the problem is singular.

    Held are the pose of the image `first` and, for the unit, its point that most images show.
    """
    pycolmap = load()
    shown = {point.point3D_id for point in first.points2D if point.has_point3D()}
    if not shown:
        return None
    problem = bundle_of(model)
    for camera in model.cameras:
        problem.set_constant_cam_intrinsics(camera)
    problem.set_constant_rig_from_world_pose(first.frame_id)
    problem.add_constant_point(max(shown, key=lambda key: (model.points3D[key].track.length(), key)))
    options = options_of(
        "BundleAdjustmentOptions",
        {"refine_focal_length": False, "refine_extra_params": False, "print_summary": False},
    )
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, problem, model)
    poses = pycolmap.BACovarianceOptions(params=pycolmap.BACovarianceOptionsParams.POSES)
    return pycolmap.estimate_ba_covariance(poses, model, adjuster)


def _spread(count: int, most: int) -> np.ndarray:
    """At most `most` rows, evenly chosen from 1 to count - 1."""
    return np.unique(np.linspace(1, count - 1, min(count - 1, most)).astype(int))


def _to_xi(T_camera_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6 6"]:
    """Derivative of xi by z."""
    t = T_camera_world[:3, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return np.block([[-2 * cross, -np.eye(3)], [-2 * np.eye(3), np.zeros((3, 3))]])

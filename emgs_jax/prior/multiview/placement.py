"""Placing a view: by landmarks of the structure, by a rotation alone, by landmarks that were left behind (OpenCV)."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from emgs_jax.keypoints import sift
from emgs_jax.keypoints.poses import essential, fits, pose_of, unit_rays
from emgs_jax.prior.multiview.landmarks import NONE, MatchingConfig, Structure, View, common
from emgs_jax.prior.multiview.memory import without

NUM_TURN_STEPS = 10  # of the rotation and of what fits it
MIN_SCALED = 6  # landmarks that tell the length of a baseline


class Baseline(NamedTuple):
    """Two views relative to each other.

    Args:
        T_a_b: with a unit baseline.
        count: of the matches that fit, in front of both cameras.
        parallax: the sine of their median parallax.
    """

    T_a_b: Float[np.ndarray, "4 4"]
    count: int
    parallax: float


def relative_pose(a: View, b: View, K: np.ndarray, config: MatchingConfig) -> Baseline | None:
    """Two views relative to each other, from the landmarks that they share; None without enough of them."""
    rows_a, rows_b = common(a, b)
    pixels_a, pixels_b = a.pixels[rows_a], b.pixels[rows_b]
    if len(pixels_a) < config.min_matches:
        return None
    E, mask = essential(pixels_a, pixels_b, K, config.max_epipolar_error)
    if E is None or E.shape != (3, 3):
        return None
    inliers = mask.ravel() > 0  # before those that are so far away that they tell nothing of the baseline are left out
    count, R, t, _ = cv2.recoverPose(E, pixels_a, pixels_b, K, mask=mask)
    if count < config.min_matches:
        return None
    rays_a, rays_b = unit_rays(pixels_a[inliers], K), unit_rays(pixels_b[inliers], K)
    parallax = np.linalg.norm(np.cross(rays_a @ R.T, rays_b), axis=1)
    T_b_a = np.eye(4)
    T_b_a[:3, :3], T_b_a[:3, 3] = R, t.ravel()
    return Baseline(np.linalg.inv(T_b_a), count, float(np.median(parallax)))


def place(structure: Structure, view: View, config: MatchingConfig) -> bool:
    """Give a view the pose that fits the landmarks which it sees; False without enough of them."""
    known = structure.known(view)
    points, pixels = structure.points[view.landmark[known]], view.pixels[known]
    found = pose_of(points, pixels, structure.K, config.min_matches, config.max_reprojection_error)
    if found is not None:
        view.T_ref_view = found[0]
    return found is not None


def turn(structure: Structure, view: View, config: MatchingConfig) -> bool:
    """Give a view the place of another, where the camera only turned in between; False where it did not.

    One rotation explains their tracks then, and no depth comes of them: after a quarter turn on the spot no landmark is
    left. Compared is with a view that landmarks hold, so that slow motion does not pass as a chain of turns.
    """
    held = [other for other in structure.placed().values() if structure.known(other).sum() >= config.min_matches]
    shared = [common(other, view) for other in held]
    count = [len(rows) for rows, _ in shared]
    if max(count, default=0) < config.min_matches:
        return False
    other, (rows_other, rows_view) = held[np.argmax(count)], shared[np.argmax(count)]
    rays, seen = unit_rays(other.pixels[rows_other], structure.K), unit_rays(view.pixels[rows_view], structure.K)
    is_near = np.ones(len(rays), bool)
    for _ in range(NUM_TURN_STEPS):
        rotation = Rotation.align_vectors(rays[is_near], seen[is_near])[0]
        error = structure.K[0, 0] * np.linalg.norm(rays - rotation.apply(seen), axis=1)
        is_near = error <= max(config.max_epipolar_error, np.median(error))
    if np.sum(error <= config.max_epipolar_error) < max(config.min_turned * len(rays), config.min_matches):
        return False
    view.T_ref_view, view.is_held = other.T_ref_view.copy(), True
    view.T_ref_view[:3, :3] = other.T_ref_view[:3, :3] @ rotation.as_matrix()
    return True


def refind(structure: Structure, view: View, config: MatchingConfig) -> bool:
    """Place a view by landmarks of the memory, which become landmarks of the view again; False without enough of them.

    The structure has drifted away from them by now: they tell how far the view's points are, and where it is only if it
    shares no tracks with a placed view (`_beside`).
    """
    # In the memory a point may be there twice, so a match is distinct among the view's keypoints only.
    rows, keypoints = sift.mutual(structure.memory.descriptors, view.descriptors, config.max_ratio)
    points = structure.memory.points[rows]
    found = pose_of(points, view.pixels[keypoints], structure.K, config.min_refound, config.max_reprojection_error)
    if found is None:
        return False
    T_then_view, inliers = found
    rows, keypoints = rows[inliers], keypoints[inliers]
    local = np.full((len(view.pixels), 3), np.nan)
    local[keypoints] = (points[inliers] - T_then_view[:3, 3]) @ T_then_view[:3, :3]
    others = [(other, relative_pose(other, view, structure.K, config)) for other in structure.placed().values()]
    beside = [(other, relative) for other, relative in others if relative is not None]
    T_ref_view = _beside(structure, view, local, beside, config) if beside else T_then_view
    if T_ref_view is None:
        return False
    view.T_ref_view, view.is_held = T_ref_view, len(beside) > 0
    is_new = view.landmark[keypoints] == NONE
    view.landmark[keypoints[is_new]] = len(structure.points) + np.arange(is_new.sum())
    structure.points = np.concatenate([structure.points, np.full((is_new.sum(), 3), np.nan)])
    structure.points[view.landmark[keypoints]] = local[keypoints] @ T_ref_view[:3, :3].T + T_ref_view[:3, 3]
    structure.memory = without(structure.memory, rows)
    return True


def _beside(
    structure: Structure,
    view: View,
    local: Float[np.ndarray, "n 3"],
    beside: list[tuple[View, Baseline]],
    config: MatchingConfig,
) -> Float[np.ndarray, "4 4"] | None:
    """T_ref_view by a placed view, the length of the baseline by points whose images both have; None where they differ.

    Args:
        structure: of the placed views.
        view: is placed.
        local: points of its keypoints, its camera's frame; NaN where not known.
        beside: placed views and how it lies to them.
        config: which error.
    """
    shared = []
    for other, relative in beside:
        rows_other, rows = common(other, view)
        has = np.isfinite(local[rows, 0])
        if has.sum() >= MIN_SCALED:
            shared.append((other, relative, rows_other[has], rows[has]))
    if not shared:
        return None
    # The length is as certain as points and parallax make it.
    other, relative, rows_other, rows = max(shared, key=lambda entry: len(entry[3]) * entry[1].parallax)
    T = relative.T_a_b.copy()
    turned, rays = local[rows] @ T[:3, :3].T, unit_rays(other.pixels[rows_other], structure.K)
    # turned + length · direction lies on the ray: least squares of each point, and their weighted median.
    across, along = np.cross(rays, turned), np.cross(rays, T[:3, 3])
    weights = (along**2).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):  # nan, the last, along the baseline: it weighs nothing
        length = -(across * along).sum(axis=1) / weights
    order = np.argsort(length)
    middle = np.searchsorted(np.cumsum(weights[order]), 0.5 * weights.sum())
    T[:3, 3] *= length[order][middle]
    num_fits = fits(turned + T[:3, 3], other.pixels[rows_other], structure.K, config.max_reprojection_error).sum()
    is_found = length[order][middle] > 0 and num_fits >= max(MIN_SCALED, 0.5 * len(rows))
    return other.T_ref_view @ T if is_found else None

"""Structure from motion of a sliding window: where its views are and where their landmarks (host side, NumPy in, out).

Each view is placed by the landmarks that it shows, and bundle adjustment refines the views of the window. While the
structure still has every view that tells something, it also measures the lens.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.ops.camera import Camera
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.ranges import number
from emgs_jax.prior.multiview.bundle_adjustment import BundleConfig, Tracks, Unknowns, adjust
from emgs_jax.prior.multiview.keys import KeyConfig
from emgs_jax.prior.multiview.landmarks import (
    NONE,
    MatchingConfig,
    Structure,
    known_common,
    straighten,
    triangulate,
)
from emgs_jax.prior.multiview.lens import distort
from emgs_jax.prior.multiview.placement import place, refind, turn
from emgs_jax.prior.multiview.sources import parallax

jitted_adjust = eqx.filter_jit(adjust)


@dataclass(frozen=True)
class StructureConfig:
    """Settings of incremental structure from motion.

    Args:
        matching: detection, matching and acceptance.
        keys: views that stay when they leave the window.
        bundle: the refinement.
        max_landmarks: that take part in the refinement; those that most views see.
        num_fixed: at most, the oldest views of a window, which fix the frame and scale of the ones before.
        num_rounds: of refinement; observations that do not fit are dropped after each.
        min_first_parallax_rad: between the rays of the median landmark of the pair of views that a structure begins
            with; with less its depths are noise.
        distortion_std: prior standard deviation of the lens' radial distortion, as k of x (1 + k |x|²) with x on the
            plane z = 1; it is measured until the first keyframe goes. 0 = the images have none.
        min_lens_parallax_rad: likewise, between the newest view and the farthest, for the lens to be measured.
        median_depth: m; assumed depth of the median landmark of the first view: images alone do not tell the scale.
        max_lost: newest views of a window, one after the other, that cannot be placed, from which on they begin a
            structure of their own; what is forgotten then is not found again. inf: never.
    """

    matching: MatchingConfig
    keys: KeyConfig
    bundle: BundleConfig
    max_landmarks: int = number(low=1)
    num_fixed: int = number(low=1, high=1000)
    num_rounds: int = number(low=1, high=100)
    min_first_parallax_rad: float = number(low=0, high=3)
    distortion_std: float = number(low=0, high=1000)
    min_lens_parallax_rad: float = number(low=0, high=3)
    median_depth: float = number(low=1e-6)
    max_lost: float = number(low=3, high=math.inf)  # fewer are no structure


def at_size(config: StructureConfig, width: int, height: int) -> StructureConfig:
    """Settings with errors in pixels of images of this size: in larger ones than `full_size` they grow in proportion.

    Before the lens is measured its distortion is most of an error (k = .03: 7 pixels in a corner of 640x480), and so
    may blur be: both grow with the image.
    """
    matching, times = config.matching, max(max(width, height) / config.matching.full_size, 1.0)
    grown = replace(
        matching,
        max_epipolar_error=matching.max_epipolar_error * times,
        max_reprojection_error=matching.max_reprojection_error * times,
        min_parallax=matching.min_parallax * times,
    )
    return replace(config, matching=grown, bundle=replace(config.bundle, pixel_std=config.bundle.pixel_std * times))


def extend(structure: Structure, camera: Camera, num_views: int, config: StructureConfig) -> None:
    """Place the views that are not placed yet, as far as they can be, and refine the window.

    What shows too few of the window's landmarks stands where another view does, or shows some that were left behind.
    """
    for find in (place, turn, refind):
        for view in structure.views.values():
            if view.T_ref_view is None and find(structure, view, config.matching):
                triangulate(structure, structure.unknown(), config.matching)
    frames = sorted(structure.placed())
    measure_lens(structure, camera, num_views, config)
    # A short window refines its two newest views too; it takes two others to hold the scale.
    num_fixed = max(min(config.num_fixed, len(frames) - 2), len(frames) - num_views)
    if num_fixed >= 2:
        refine(structure, camera, num_views, frames[:num_fixed], config)


def measure_lens(structure: Structure, camera: Camera, num_views: int, config: StructureConfig) -> None:
    """Measure the distortion of the lens by all views that there are, and move the keypoints.

    Views that lie near to each other blame the lens for the noise of their depths, so what they say is left out below
    `min_lens_parallax_rad`, and counts by the parallax squared above. Of the adjustment only the lens is taken: in
    `refine` the views that are held hold the scale.
    """
    if structure.is_lens_known or config.distortion_std == 0:
        return
    largest = _largest_parallax(structure, config)
    if largest == 0 or largest < config.min_lens_parallax_rad:
        return
    *_, distortion, _ = _solve(structure, camera, num_views, sorted(structure.placed())[:1], config, measures=True)
    structure.distortion_weight += largest**2
    share = largest**2 / structure.distortion_weight
    straighten(structure, structure.distortion + share * (distortion - structure.distortion))


def refine(
    structure: Structure, camera: Camera, num_views: int, fixed: Collection[int], config: StructureConfig
) -> None:
    """Bundle adjustment of all placed views; drops what does not fit, and triangulates all other tracks anew.

    Those were triangulated by poses as they were then, and by the first views that showed them, the nearest.
    """
    for _ in range(config.num_rounds):
        placed = structure.placed()
        frames, held = sorted(placed), {*fixed, *(frame for frame in placed if placed[frame].is_held)}
        ids, poses, points, _, error = _solve(structure, camera, num_views, held, config)
        structure.points[ids] = points
        for row, frame in enumerate(frames):
            if frame not in held:
                structure.views[frame].T_ref_view = poses[row]
        _drop(structure, frames, held, ids, error, config)
        others = np.ones(len(structure.points), bool)
        others[ids] = structure.unknown()[ids]
        triangulate(structure, others, config.matching)


def _largest_parallax(structure: Structure, config: StructureConfig) -> float:
    """Of the median landmark between the newest view and another (sine); 0 where it shares too little with each."""
    placed, largest = structure.placed(), 0.0
    newest = placed.get(max(placed, default=-1))
    for other in placed.values():
        rows, _ = known_common(structure, newest, other)
        if len(rows) >= config.matching.min_matches:
            points = structure.points[newest.landmark[rows]]
            angles = parallax(points, newest.T_ref_view[:3, 3], other.T_ref_view[:3, 3])
            largest = max(largest, float(np.median(angles)))
    return largest


@full_precision
def _solve(
    structure: Structure,
    camera: Camera,
    num_views: int,
    fixed: Collection[int],
    config: StructureConfig,
    measures: bool = False,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, np.ndarray]:
    """Landmarks that take part (l,), poses of all placed views, their points (l, 3), lens and errors as in `adjust`."""
    frames, num_rows = sorted(structure.placed()), num_views + config.keys.max_keys
    ids, tracks = _tracks(structure, frames, num_rows, config)
    if measures:
        shown = distort(np.asarray(tracks.pixels), structure.lens())
        tracks = Tracks(jnp.asarray(shown, jnp.float32), tracks.is_seen)
    poses = np.tile(np.eye(4), (num_rows, 1, 1))
    poses[: len(frames)] = [structure.views[frame].T_ref_view for frame in frames]
    points = np.zeros((config.max_landmarks, 3))
    points[: len(ids)] = structure.points[ids]
    free = [row if row < len(frames) and frames[row] not in fixed else num_rows for row in range(num_rows)]
    T, points, distortion, error = jitted_adjust(
        jaxlie.SE3.from_matrix(jnp.asarray(poses, jnp.float32)),
        jnp.asarray(points, jnp.float32),
        tracks,
        Unknowns(
            jnp.asarray(free, jnp.int32),
            jnp.asarray(structure.distortion, jnp.float32),
            jnp.asarray(config.distortion_std * measures, jnp.float32),
        ),
        camera,
        config.bundle,
    )
    poses, points = np.asarray(T.as_matrix(), np.float64), np.asarray(points, np.float64)
    return ids, poses, points[: len(ids)], float(distortion), np.asarray(error)


def _columns(structure: Structure, ids: np.ndarray) -> np.ndarray:
    """Position in `ids` of every landmark, or NONE; NONE itself looks up the last entry, which is NONE."""
    column = np.full(len(structure.points) + 1, NONE)
    column[ids] = np.arange(len(ids))
    return column


def _tracks(
    structure: Structure, frames: list[int], num_rows: int, config: StructureConfig
) -> tuple[np.ndarray, Tracks]:
    """The landmarks that most views see, and where."""
    views = [structure.views[frame] for frame in frames]
    seen = np.concatenate([view.landmark[structure.known(view)] for view in views])
    ids, count = np.unique(seen, return_counts=True)
    ids = ids[count >= 2][np.argsort(-count[count >= 2], kind="stable")][: config.max_landmarks]
    column = _columns(structure, ids)
    pixels = np.zeros((num_rows, config.max_landmarks, 2), np.float32)
    is_seen = np.zeros((num_rows, config.max_landmarks), bool)
    for row, view in enumerate(views):
        places = column[view.landmark]
        pixels[row, places[places >= 0]] = view.pixels[places >= 0]
        is_seen[row, places[places >= 0]] = True
    return ids, Tracks(jnp.asarray(pixels), jnp.asarray(is_seen))


def _drop(
    structure: Structure,
    frames: list[int],
    fixed: Collection[int],
    ids: np.ndarray,
    error: np.ndarray,
    config: StructureConfig,
) -> None:
    """Take landmarks from the keypoints that do not fit them, and positions from those that too few views see.

    Views that are held keep theirs: where a newer pose is wrong for a while, they would lose what holds it.
    """
    column = _columns(structure, ids)
    count = np.zeros(len(ids), int)
    for row, frame in enumerate(frames):
        view = structure.views[frame]
        places = column[view.landmark]
        fits = (places < 0) | (error[row, places] < config.matching.max_reprojection_error)
        if frame not in fixed:
            view.landmark[~fits] = NONE
        count[places[fits & (places >= 0)]] += 1
    structure.points[ids[count < 2]] = np.nan

"""Structure from motion of a sliding window: where its views are and where their landmarks (host side, NumPy in, out).

The first window in which that succeeds is built from its best pair of views (Schönberger and Frahm,
"Structure-from-motion revisited", CVPR 2016); each later view is placed by the landmarks that it shows. Bundle
adjustment refines the views of the window. Views that have lost the structure begin one of their own.
"""

import math
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.ops.camera import Camera
from emgs_jax.ops.ranges import number
from emgs_jax.prior.multiview.bundle_adjustment import BundleConfig, Tracks, Unknowns, adjust
from emgs_jax.prior.multiview.keys import KeyConfig
from emgs_jax.prior.multiview.landmarks import (
    NONE,
    MatchingConfig,
    Structure,
    View,
    place,
    refind,
    relative_pose,
    straighten,
    triangulate,
)

jitted_adjust = eqx.filter_jit(adjust)


@dataclass(frozen=True)
class StructureConfig:
    """How the structure grows.

    Args:
        matching: detection, matching and acceptance.
        keys: views that stay when they leave the window.
        bundle: the refinement.
        max_landmarks: that take part in the refinement; those that most views see.
        num_fixed: at most, the oldest views of a window, which hold the frame and scale of the ones before.
        num_rounds: of refinement; observations that do not fit are dropped after each.
        distortion_std: what the radial distortion of the lens is expected to be, as k of x (1 + k |x|²) with x on the
            plane z = 1; it is measured in the first window. 0 = the images have none.
        median_depth: m; what the median landmark of the first view is taken for: images alone do not tell the scale.
        max_lost: newest views of a window, one after the other, that cannot be placed, from which on they begin a
            structure of their own; what is forgotten then is not found again. inf: never.
    """

    matching: MatchingConfig
    keys: KeyConfig
    bundle: BundleConfig
    max_landmarks: int = number(low=1)
    num_fixed: int = number(low=1, high=1000)
    num_rounds: int = number(low=1, high=100)
    distortion_std: float = number(low=0, high=1000)
    median_depth: float = number(low=1e-6)
    max_lost: float = number(low=3, high=math.inf)  # fewer are no structure


def initialize(structure: Structure, camera: Camera, num_views: int, config: StructureConfig) -> bool:
    """Place the views of a window, the oldest of which is the reference; False without enough parallax or matches."""
    pairs = _ranked_pairs(structure, config)
    for a, b, T_a_b in pairs[:3]:
        _reset(structure)
        structure.views[a].T_ref_view, structure.views[b].T_ref_view = np.eye(4), T_a_b
        triangulate(structure, config.matching)
        _grow(structure, camera, num_views, a, config)
        placed = structure.placed()
        reference = placed[min(placed)]
        # Two views alone are confirmed by nothing.
        if len(placed) > 2 and structure.known(reference).sum() >= config.matching.min_matches:
            if config.distortion_std > 0:
                refine(structure, camera, num_views, [a], config, config.distortion_std)
            _normalize(structure, reference, config)
            return True
    _reset(structure)
    return False


def extend(structure: Structure, camera: Camera, num_views: int, config: StructureConfig) -> None:
    """Place the views that are not placed yet, as far as they can be, and refine the window.

    What shows none of the window's landmarks is looked for among those that were left behind.
    """
    for find in (place, refind):
        for view in structure.views.values():
            if view.T_ref_view is None and find(structure, view, config.matching):
                triangulate(structure, config.matching)
    frames = sorted(structure.placed())
    # A short window refines its two newest views too; it takes two others to hold the scale.
    num_fixed = max(min(config.num_fixed, len(frames) - 2), len(frames) - num_views)
    if num_fixed >= 2:
        refine(structure, camera, num_views, frames[:num_fixed], config)


def begin_again(
    structure: Structure, current: int, camera: Camera, num_views: int, config: StructureConfig
) -> Structure | None:
    """A structure of the newest views alone, where these have lost the one that there is; None where they have not.

    Nothing relates it to the other, of which it has neither views nor landmarks: its frame is that of its first view,
    its scale that of its own `median_depth`. The lens is the same.

    Args:
        structure: after `extend`; it stays as it is.
        current: a view that must be placed by then.
        camera: of the images.
        num_views: at most, in a window.
        config: of both.
    """
    last = max(structure.placed(), default=-1)
    lost = {frame: view for frame, view in structure.views.items() if frame > last}
    if current not in lost or len(lost) < config.max_lost:
        return None
    views = {frame: replace(view, landmark=view.landmark.copy()) for frame, view in lost.items()}
    new = Structure(structure.K, views, np.full_like(structure.points, np.nan), structure.distortion)
    has_begun = initialize(new, camera, num_views, replace(config, distortion_std=0.0))
    return new if has_begun and current in new.placed() else None


def refine(
    structure: Structure,
    camera: Camera,
    num_views: int,
    fixed: list[int],
    config: StructureConfig,
    distortion_std: float = 0.0,
) -> None:
    """Bundle adjustment of all placed views; drops what does not fit and triangulates what now does.

    With a `distortion_std` the lens is measured in the first round, and keypoints move to where a pinhole sees them.
    """
    num_rows = num_views + config.keys.max_keys
    for count in range(config.num_rounds):
        is_measured = distortion_std > 0 and count == 0
        frames = sorted(structure.placed())
        ids, tracks = _tracks(structure, frames, num_rows, config)
        poses = np.tile(np.eye(4), (num_rows, 1, 1))
        poses[: len(frames)] = [structure.views[frame].T_ref_view for frame in frames]
        points = np.zeros((config.max_landmarks, 3))
        points[: len(ids)] = structure.points[ids]
        free = [row for row, frame in enumerate(frames) if frame not in fixed]
        T, points, distortion, error = jitted_adjust(
            jaxlie.SE3.from_matrix(jnp.asarray(poses, jnp.float32)),
            jnp.asarray(points, jnp.float32),
            tracks,
            Unknowns(_padded(free, num_views, num_rows), jnp.asarray(distortion_std * is_measured, jnp.float32)),
            camera,
            config.bundle,
        )
        poses, error = np.asarray(T.as_matrix(), np.float64), np.asarray(error)
        structure.points[ids] = np.asarray(points, np.float64)[: len(ids)]
        for row, frame in enumerate(frames):
            if frame not in fixed:
                structure.views[frame].T_ref_view = poses[row]
        if is_measured:
            straighten(structure, float(distortion))
        _drop(structure, frames, fixed, ids, error, config)
        triangulate(structure, config.matching)


def _padded(rows: list[int], count: int, other: int) -> jnp.ndarray:
    return jnp.asarray(rows + [other] * (count - len(rows)), jnp.int32)


def _ranked_pairs(structure: Structure, config: StructureConfig) -> list[tuple[int, int, np.ndarray]]:
    """Pairs of views with their relative pose, the one with most matches and parallax first."""
    frames, found = sorted(structure.views), []
    for i, a in enumerate(frames):
        for b in frames[i + 1 :]:
            result = relative_pose(structure.views[a], structure.views[b], structure.K, config.matching)
            if result is not None:
                found.append((result[1], a, b, result[0]))
    return [item[1:] for item in sorted(found, key=lambda item: -item[0])]


def _grow(structure: Structure, camera: Camera, num_views: int, origin: int, config: StructureConfig) -> None:
    """Place one view after the other, the one with most known landmarks first."""
    while True:
        refine(structure, camera, num_views, [origin], config)
        waiting = [view for view in structure.views.values() if view.T_ref_view is None]
        waiting.sort(key=lambda view: -structure.known(view).sum())
        if not any(place(structure, view, config.matching) for view in waiting):
            return
        triangulate(structure, config.matching)


def _reset(structure: Structure) -> None:
    structure.points[:] = np.nan
    for view in structure.views.values():
        view.T_ref_view = None


def _normalize(structure: Structure, reference: View, config: StructureConfig) -> None:
    """Make a placed view the reference and its median landmark `median_depth` deep."""
    T_first_ref = np.linalg.inv(reference.T_ref_view)
    structure.points = structure.points @ T_first_ref[:3, :3].T + T_first_ref[:3, 3]
    depth = structure.points[reference.landmark[structure.known(reference)], 2]
    scale = config.median_depth / np.median(depth)
    structure.points *= scale
    for view in structure.placed().values():
        view.T_ref_view = T_first_ref @ view.T_ref_view
        view.T_ref_view[:3, 3] *= scale


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
    fixed: list[int],
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

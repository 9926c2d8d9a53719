"""The first views of a structure, from images alone.

The first window in which that succeeds is built from its best pair of views (Schönberger and Frahm,
"Structure-from-motion revisited", CVPR 2016). Views that have lost the structure begin one of their own.
"""

from dataclasses import replace

import numpy as np

from emgs_jax.ops.camera import Camera
from emgs_jax.prior.multiview.incremental import StructureConfig, measure_lens, refine
from emgs_jax.prior.multiview.landmarks import Structure, View, triangulate
from emgs_jax.prior.multiview.memory import Memory
from emgs_jax.prior.multiview.placement import place, relative_pose


def initialize(structure: Structure, camera: Camera, num_views: int, config: StructureConfig) -> bool:
    """Place the views of a window, the oldest of which is the reference; False without enough parallax or matches."""
    pairs = _ranked_pairs(structure, config)
    for a, b, T_a_b in pairs[:3]:
        _reset(structure)
        structure.views[a].T_ref_view, structure.views[b].T_ref_view = np.eye(4), T_a_b
        triangulate(structure, structure.unknown(), config.matching)
        _grow(structure, camera, num_views, a, config)
        placed = structure.placed()
        reference = placed[min(placed)]
        # Two views alone are confirmed by nothing.
        if len(placed) > 2 and structure.known(reference).sum() >= config.matching.min_matches:
            measure_lens(structure, camera, num_views, config)
            refine(structure, camera, num_views, [a], config)
            _normalize(structure, reference, config)
            return True
    _reset(structure)
    return False


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
    new = replace(
        structure,
        views=views,
        points=np.full_like(structure.points, np.nan),
        memory=Memory(),
        is_lens_known=structure.distortion_weight > 0,
    )
    has_begun = initialize(new, camera, num_views, config)
    return new if has_begun and current in new.placed() else None


def _ranked_pairs(structure: Structure, config: StructureConfig) -> list[tuple[int, int, np.ndarray]]:
    """Pairs of views with their relative pose, the one with most matches and parallax first."""
    frames, found = sorted(structure.views), []
    for i, a in enumerate(frames):
        for b in frames[i + 1 :]:
            result = relative_pose(structure.views[a], structure.views[b], structure.K, config.matching)
            if result is not None and result.parallax >= config.min_first_parallax_rad:
                T_a_b, count, parallax = result
                found.append((count * parallax, a, b, T_a_b))
    return [item[1:] for item in sorted(found, key=lambda item: -item[0])]


def _grow(structure: Structure, camera: Camera, num_views: int, origin: int, config: StructureConfig) -> None:
    """Place one view after the other, the one with most known landmarks first."""
    while True:
        refine(structure, camera, num_views, [origin], config)
        waiting = [view for view in structure.views.values() if view.T_ref_view is None]
        waiting.sort(key=lambda view: -structure.known(view).sum())
        if not any(place(structure, view, config.matching) for view in waiting):
            return
        triangulate(structure, structure.unknown(), config.matching)


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

"""Points of the scene that several images show: verified matches, tracks and where they lie."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from emgs_jax.keypoints import sift
from emgs_jax.keypoints.poses import essential, fits, unit_rays
from emgs_jax.ops.ranges import number
from emgs_jax.prior.multiview.lens import Lens, distort, straight
from emgs_jax.prior.multiview.memory import Memory, remember

NONE = -1  # a keypoint without a landmark


@dataclass(frozen=True)
class MatchingConfig:
    """Detection, matching and acceptance; errors in pixels of an image up to `full_size`.

    Args:
        num_features: at most, in one image.
        min_contrast: of a keypoint (SIFT).
        magnification: of the image before its keypoints are looked for.
        full_size: pixels of an image's longer side; in larger images errors, here and of the bundle adjustment, and
            parallax count in proportion.
        max_ratio: distance to the best descriptor over that to the second (Lowe, IJCV 2004).
        max_epipolar_error: of a match that fits the essential matrix.
        max_reprojection_error: of an observation that fits its landmark.
        min_matches: that a pair of images, or an image and the landmarks, must have.
        min_parallax: pixels between the rays of a landmark, as the root of the rays' smallest variance. A landmark with
            little has an uncertain depth, but it holds a camera that turns where it stands.
        min_turned: share of the tracks of two views that one rotation must explain where the camera turns on the spot.
        min_refound: landmarks that a view which shows none of its neighbours' must find again to be placed by them.
        max_remembered: landmarks that no view of the window shows any more; the oldest go.
    """

    num_features: int = number(low=1)
    min_contrast: float = number(low=0, high=1)
    magnification: int = number(low=1, high=8)
    full_size: int = number(low=1)
    max_ratio: float = number(low=0, high=1)
    max_epipolar_error: float = number(low=0, high=1000)
    max_reprojection_error: float = number(low=0, high=1000)
    min_matches: int = number(low=1)
    min_parallax: float = number(low=0, high=1000)
    min_turned: float = number(low=0, high=1)
    min_refound: int = number(low=6)  # a pose needs as many
    max_remembered: int = number(low=0, high=1e8)

    def __post_init__(self) -> None:
        if self.min_matches < 6:
            raise ValueError(f"min_matches must be at least 6, which a pose needs; got {self.min_matches}")


@dataclass
class View:
    """Keypoints of one image and its pose.

    Args:
        pixels: (n, 2) float64 of the keypoints, where a pinhole camera sees them.
        descriptors: (n, 128) float32, unit.
        landmark: (n,) the landmark of each keypoint, or NONE.
        T_ref_view: camera -> reference (4, 4); None while it is not placed.
        is_held: landmarks do not tie the pose to those before; the bundle adjustment leaves it as it is.
    """

    pixels: np.ndarray
    descriptors: np.ndarray
    landmark: np.ndarray
    T_ref_view: np.ndarray | None = None
    is_held: bool = False


@dataclass
class Structure:
    """Views by frame index, and landmarks: `points` (l, 3) in the reference frame, NaN where not triangulated.

    `distortion` of the lens is the mean of what windows measured, with weights that add up to `distortion_weight`; it
    changes until it `is_lens_known`.
    """

    K: np.ndarray
    views: dict[int, View] = field(default_factory=dict)
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    distortion: float = 0.0
    memory: Memory = field(default_factory=Memory)
    distortion_weight: float = 0.0
    is_lens_known: bool = False

    def lens(self) -> Lens:
        """Return the lens that the images were taken with."""
        return Lens(self.K.diagonal()[:2], self.K[:2, 2], self.distortion)

    def placed(self) -> dict[int, View]:
        """The views that have a pose, by frame."""
        return {frame: view for frame, view in self.views.items() if view.T_ref_view is not None}

    def unknown(self) -> np.ndarray:
        """Mark the landmarks (l,) without a position."""
        return np.isnan(self.points[:, 0])

    def known(self, view: View) -> np.ndarray:
        """Mark the keypoints (n,) of a view that have a landmark with a position."""
        has = view.landmark >= 0
        has[has] = np.isfinite(self.points[view.landmark[has], 0])
        return has


def detect(gray: np.ndarray, config: MatchingConfig) -> View:
    """The keypoints of an image (h, w) uint8, without landmarks and not placed."""
    pixels, descriptors = sift.detect(gray, config.num_features, config.min_contrast, config.magnification)
    return View(pixels, descriptors, np.full(len(pixels), NONE))


def straighten(structure: Structure, distortion: float) -> None:
    """Move the keypoints to where a pinhole camera sees what a lens of this distortion shows."""
    before, structure.distortion = structure.lens(), distortion
    for view in structure.views.values():
        view.pixels = straight(distort(view.pixels, before), structure.lens())


def match(a: View, b: View, K: np.ndarray, config: MatchingConfig) -> tuple[np.ndarray, np.ndarray]:
    """Rows of `a` and `b` that are each other's nearest, distinctly so, and fit one essential matrix (MAGSAC++)."""
    none = np.zeros(0, int), np.zeros(0, int)
    if min(len(a.pixels), len(b.pixels)) < max(config.min_matches, 2):
        return none
    rows, nearest = sift.mutual(a.descriptors, b.descriptors, config.max_ratio)
    if len(rows) < config.min_matches:
        return none
    _, mask = essential(a.pixels[rows], b.pixels[nearest], K, config.max_epipolar_error)
    if mask is None or mask.sum() < config.min_matches:
        return none
    inliers = mask.ravel().astype(bool)
    return rows[inliers], nearest[inliers]


def link(structure: Structure, frame: int, config: MatchingConfig) -> None:
    """Match a view with all others, nearest in time first, and extend or begin tracks."""
    view, count = structure.views[frame], len(structure.points)
    seen = set(view.landmark.tolist()) - {NONE}
    for other_frame in sorted(structure.views, key=lambda index: abs(index - frame)):
        if other_frame == frame:
            continue
        other = structure.views[other_frame]
        for there, here in zip(*match(other, view, structure.K, config), strict=True):
            known = other.landmark[there]
            if view.landmark[here] != NONE or known in seen:
                continue
            if known == NONE:
                known = other.landmark[there] = count
                count += 1
            view.landmark[here] = known
            seen.add(known)
    structure.points = np.concatenate([structure.points, np.full((count - len(structure.points), 3), np.nan)])


def forget(structure: Structure, frames: Sequence[int], config: MatchingConfig) -> None:
    """Drop these views; landmarks that no other view shows go to the memory, the others are renumbered."""
    leaving = [structure.views.pop(frame) for frame in frames]
    used = np.zeros(len(structure.points), bool)
    for view in structure.views.values():
        used[view.landmark[view.landmark >= 0]] = True
    kept = used.copy()
    for view in leaving:
        rows = np.flatnonzero(structure.known(view))
        rows = rows[~kept[view.landmark[rows]]]
        kept[view.landmark[rows]] = True
        points, descriptors = structure.points[view.landmark[rows]], view.descriptors[rows]
        structure.memory = remember(structure.memory, points, descriptors, config.max_remembered)
    number = np.append(np.where(used, np.cumsum(used) - 1, NONE), NONE)  # of NONE, the last: NONE
    for view in structure.views.values():
        view.landmark = number[view.landmark]
    structure.points = structure.points[used]


def common(a: View, b: View) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints of two views, row by row, that have the same landmark."""
    _, rows_a, rows_b = np.intersect1d(a.landmark, b.landmark, return_indices=True)
    has = a.landmark[rows_a] != NONE
    return rows_a[has], rows_b[has]


def known_common(structure: Structure, a: View, b: View) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints of two views that have the same landmark, whose position is known."""
    rows_a, rows_b = common(a, b)
    is_known = structure.known(a)[rows_a]
    return rows_a[is_known], rows_b[is_known]


def confirmed(structure: Structure, view: View, others: Sequence[View], max_error: float) -> np.ndarray:
    """Mark the landmarks (l,) that a placed view shows, and one of other placed views too, there where they are.

    Where a camera turns on the spot the rays of a wrong match meet, too: close to the camera. A view from elsewhere
    shows nothing there.

    Args:
        structure: of the views.
        view: whose landmarks are asked for.
        others: views from elsewhere.
        max_error: of a keypoint from its landmark's image, pixels.
    """
    marked = np.zeros(len(structure.points), bool)
    for other in others:
        _, rows = known_common(structure, view, other)
        ids = other.landmark[rows]
        local = (structure.points[ids] - other.T_ref_view[:3, 3]) @ other.T_ref_view[:3, :3]
        marked[ids[fits(local, other.pixels[rows], structure.K, max_error)]] = True
    return marked


def triangulate(structure: Structure, wanted: np.ndarray, config: MatchingConfig) -> None:
    """Give tracks the point nearest to their rays where these have parallax; else the point that they had stays.

    Of a track whose point does not fit every placed view that shows it, the position is no longer known.

    Args:
        structure: with placed views.
        wanted: mark the tracks (l,) that are triangulated; the others stay.
        config: how much parallax, which error.
    """
    placed = list(structure.placed().values())
    landmark = np.concatenate([view.landmark for view in placed])
    views = np.repeat(np.arange(len(placed)), [len(view.landmark) for view in placed])
    pixels = np.concatenate([view.pixels for view in placed])
    shown = np.append(wanted, False)[landmark]  # NONE, the last, is never wanted
    landmark, views, pixels = landmark[shown], views[shown], pixels[shown]
    if not len(landmark):
        return
    ids, track = np.unique(landmark, return_inverse=True)
    poses = np.stack([view.T_ref_view for view in placed])
    rays = np.einsum("nij,nj->ni", poses[views, :3, :3], unit_rays(pixels, structure.K))
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    hessian, right, count = np.zeros((len(ids), 3, 3)), np.zeros((len(ids), 3)), np.bincount(track)
    np.add.at(hessian, track, across)
    np.add.at(right, track, np.einsum("nij,nj->ni", across, poses[views, :3, 3]))
    parallax_sq = np.linalg.eigvalsh(hessian)[:, 0] / count
    apart = (count >= 2) & (parallax_sq > (config.min_parallax / structure.K[0, 0]) ** 2)
    points = structure.points[ids]
    points[apart] = np.linalg.solve(hessian[apart], right[apart][..., None])[..., 0]
    local = np.einsum("nji,nj->ni", poses[views, :3, :3], points[track] - poses[views, :3, 3])
    is_there = fits(local, pixels, structure.K, config.max_reprojection_error)
    points[np.bincount(track, ~is_there) > 0] = np.nan
    structure.points[ids] = points

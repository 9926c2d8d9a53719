"""The focal length of a camera from its images alone: the one under which pairs of views become rigid motions.

Square pixels, principal point in the middle, no distortion. A fundamental matrix F of two views is known without any
calibration; KᵀFK has two equal singular values for the true focal length only. That gives a start over a grid; then all
pairs together choose relative poses and one focal length by their epipolar errors, so that a pair counts as much as it
knows. Turning on the spot, going straight ahead and looking at one plane say nothing, and are refused.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

OFFSETS = (0, 1, 2, 4, 8, 16)  # images of a stretch: gaps of all lengths, whatever the camera's speed
NUM_STRETCHES = 12  # spread over the sequence
MAX_SIDE = 960  # pixels; larger images are made smaller, matching gains nothing from more
NUM_FEATURES = 2000
MIN_CONTRAST = 0.02  # of a SIFT keypoint; half of OpenCV's value, as rooms have pale walls
MAX_RATIO = 0.8  # nearest over second nearest descriptor (Lowe)
MAX_EPIPOLAR_ERROR = 1.0  # pixels
MIN_MATCHES = 30  # that fit the fundamental matrix, seven of whose numbers they choose
MIN_FLOW = 0.015  # median, share of the width: 10 px of 640; less is noise
MAX_PLANAR = 0.8  # share that a homography explains; of a plane or a rotation it is nearly all, F is then arbitrary
RANGE = (0.3, 3.0)  # focal lengths over the width: 118 to 19 degrees
GRID = 200  # steps of 1.2 %
ESSENTIAL_SCALE = 0.05  # difference of the singular values, relative, beyond which a pair counts as an outlier
MIN_PAIRS = 20  # single pairs scatter by tens of percent; only their sum counts
MAX_SPREAD = 0.05  # of the focal length
NUM_STEPS, MIN_GAIN = 50, 1e-4  # of the joint fit: it ends where a step takes off less of the cost, relative
DIFFERENCE = 1e-6  # of log f and of angles, for derivatives


@dataclass(frozen=True)
class Pair:
    """Two views of one camera.

    Args:
        pixels: matches that fit F, (2, m, 2).
        F: fundamental matrix (3, 3), pixels[1]ᵀ F pixels[0] = 0.
        stretch: number of the piece of the sequence that they are from: what disturbs one pair disturbs the others.
        T: motion with a unit translation, (3, 4), x_1 = R x_0 + t; None before it is known.
    """

    pixels: np.ndarray
    F: np.ndarray
    stretch: int
    T: np.ndarray | None = None


@dataclass(frozen=True)
class FocalLength:
    """Focal length estimated from images, in pixels.

    Args:
        value: estimate from all pairs of images together.
        spread: its standard deviation, from the scatter of the pairs' gradients.
        quartiles: of the estimates from single pairs; they scatter far more than the value.
        num_pairs, num_images: that the estimate rests on.
    """

    value: float
    spread: float
    quartiles: tuple[float, float]
    num_pairs: int
    num_images: int


def estimate_focal_length(count: int, read: Callable[[int], UInt8[np.ndarray, "_ _ 3"] | None]) -> FocalLength:
    """Estimate from images 0..count-1 of one size in order of time; `read` gives RGB, None for one to leave out.

    Raises:
        ValueError: too little parallax, or images that fit many focal lengths.
    """
    chosen = choose_pairs(count)
    views, width, size = {}, 1, (1, 1)
    for index in sorted({index for pair in chosen for index in pair}):
        image = read(index)
        if image is not None:
            width = image.shape[1]
            small = shrink(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
            size = small.shape[1::-1]
            views[index] = keypoints(small)
    pairs = []
    for (a, b), stretch in chosen.items():
        if a in views and b in views and (pair := two_views(match(views[a], views[b]), size, stretch)) is not None:
            pairs.append(pair)
    found = fit_focal_length(pairs, size)
    scale = width / size[0]
    quartiles = found.quartiles[0] * scale, found.quartiles[1] * scale
    return replace(
        found, value=found.value * scale, spread=found.spread * scale, quartiles=quartiles, num_images=len(views)
    )


def choose_pairs(count: int) -> dict[tuple[int, int], int]:
    """Pairs of images, and the stretch that each is from; stretches are spread evenly over all `count`."""
    starts = np.unique(np.linspace(0, max(count - 1 - OFFSETS[-1], 0), NUM_STRETCHES).round().astype(int)).tolist()
    stretches = [[start + offset for offset in OFFSETS if start + offset < count] for start in starts]
    return {pair: number for number, stretch in enumerate(stretches) for pair in combinations(stretch, 2)}


def shrink(gray: UInt8[np.ndarray, "_ _"]) -> UInt8[np.ndarray, "_ _"]:
    """The image with a longer side of at most MAX_SIDE."""
    scale = MAX_SIDE / max(gray.shape)
    if scale >= 1:
        return gray
    h, w = gray.shape
    return cv2.resize(gray, (round(w * scale), round(h * scale)), interpolation=cv2.INTER_AREA)


def keypoints(gray: UInt8[np.ndarray, "_ _"]) -> tuple[np.ndarray, np.ndarray]:
    """SIFT pixels (n, 2) and the square roots of their normalised descriptors (n, 128)."""
    detector = cv2.SIFT_create(nfeatures=NUM_FEATURES, contrastThreshold=MIN_CONTRAST, enable_precise_upscale=True)
    points, descriptors = detector.detectAndCompute(gray, None)
    if not points:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6)
    return np.array([point.pt for point in points], np.float64), np.sqrt(descriptors / total)


def match(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> Float[np.ndarray, "2 m 2"]:
    """Pixels of keypoints that are each other's nearest, distinctly so."""
    if min(len(a[0]), len(b[0])) < 2:
        return np.zeros((2, 0, 2))
    similarity = a[1] @ b[1].T
    nearest = similarity.argmax(axis=1)
    best, second = -np.partition(-similarity, 1, axis=1)[:, :2].T
    is_distinct = 1 - best < MAX_RATIO**2 * (1 - second)  # of unit vectors |d|² = 2 - 2 cos
    is_mutual = similarity.argmax(axis=0)[nearest] == np.arange(len(nearest))
    rows = np.flatnonzero(is_distinct & is_mutual)
    return np.stack([a[0][rows], b[0][nearest[rows]]])


def two_views(pixels: Float[np.ndarray, "2 m 2"], size: tuple[int, int], stretch: int = 0) -> Pair | None:
    """The matches that fit one fundamental matrix (MAGSAC++), where it is well determined; else None."""
    if pixels.shape[1] < MIN_MATCHES:
        return None
    try:
        F, mask = cv2.findFundamentalMat(*pixels, cv2.USAC_MAGSAC, MAX_EPIPOLAR_ERROR, 0.9999, 5000)
    except cv2.error:  # OpenCV 5 raises where no sample gives a matrix
        return None
    if F is None or F.shape != (3, 3):
        return None
    pixels = pixels[:, mask.ravel() > 0]
    if pixels.shape[1] < MIN_MATCHES:
        return None
    if np.median(np.linalg.norm(pixels[1] - pixels[0], axis=-1)) < MIN_FLOW * size[0]:
        return None
    _, planar = cv2.findHomography(*pixels, cv2.USAC_MAGSAC, 2 * MAX_EPIPOLAR_ERROR, None, 2000, 0.9999)
    return None if planar is not None and planar.mean() > MAX_PLANAR else Pair(pixels, F, stretch)


def fit_focal_length(pairs: list[Pair], size: tuple[int, int]) -> FocalLength:
    """The focal length of all pairs of images of `size`; ValueError where they do not determine one."""
    remedy = "dataset.intrinsics=estimate needs a camera that moves aside, past things at several distances: give "
    remedy += "dataset.intrinsics=[fx,fy,cx,cy], a calibration file or exif"
    if len(pairs) < MIN_PAIRS:
        raise ValueError(
            f"the focal length cannot be estimated: {len(pairs)} pairs of images have parallax and at least "
            f"{MIN_MATCHES} matches, {MIN_PAIRS} are needed; {remedy}"
        )
    focals = size[0] * np.geomspace(*RANGE, GRID)
    center = np.array([size[0] - 1, size[1] - 1]) / 2
    costs = essential_costs(np.stack([pair.F for pair in pairs]), focals, center)
    best = int((costs**2 / (costs**2 + ESSENTIAL_SCALE**2)).sum(axis=0).argmin())
    value, spread = refine_focal_length(pairs, float(focals[best]), center)
    if not (focals[0] < value < focals[-1] and spread < MAX_SPREAD * value):
        raise ValueError(
            f"the focal length cannot be estimated: {len(pairs)} pairs of images fit many of them (standard deviation "
            f"{100 * spread / value:.0f} %); {remedy}"
        )
    lower, upper = np.quantile(focals[costs.argmin(axis=1)], [0.25, 0.75])
    return FocalLength(value, spread, (float(lower), float(upper)), len(pairs), 0)


def essential_costs(
    F: Float[np.ndarray, "p 3 3"], focals: Float[np.ndarray, " g"], center: Float[np.ndarray, " 2"]
) -> Float[np.ndarray, "p g"]:
    """1 - s2 / s1 of the singular values of KᵀFK, 0 for an essential matrix."""
    K = np.stack([camera_matrix(focal, center) for focal in focals])
    values = np.linalg.svd(np.einsum("gji,pjk,gkl->pgil", K, F, K), compute_uv=False)
    return 1 - values[..., 1] / values[..., 0]


def camera_matrix(focal: float, center: Float[np.ndarray, " 2"]) -> Float[np.ndarray, "3 3"]:
    """K of square pixels."""
    return np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]])


def refine_focal_length(pairs: list[Pair], focal: float, center: Float[np.ndarray, " 2"]) -> tuple[float, float]:
    """Value and standard deviation: the least robust epipolar error over poses of all pairs and one focal length.

    Levenberg-Marquardt; the five numbers of each pair are eliminated, so pair i pulls at log f with b_i and holds it
    with a_i. The deviation is that of the sum of pulls b of whole stretches, sqrt(Σ b²) / Σ a: it needs no law of the
    matches' noise, and what is wrong in all pairs of a stretch counts once.
    """
    pairs = [with_motion(pair, focal, center) for pair in pairs]
    damping, systems = 1e-3, [normal_equations(pair, focal, center) for pair in pairs]
    for _ in range(NUM_STEPS):
        eliminated = [eliminate(A, b, damping) for _, A, b in systems]
        step = float(np.clip(-sum(b for _, b, *_ in eliminated) / sum(a for a, *_ in eliminated), -0.2, 0.2))
        moved = [moved_by(pair, solve(step)) for pair, (_, _, solve) in zip(pairs, eliminated, strict=True)]
        tried = [normal_equations(pair, focal * np.exp(step), center) for pair in moved]
        before, after = sum(cost for cost, *_ in systems), sum(cost for cost, *_ in tried)
        if after > before:
            damping *= 10
            continue
        pairs, systems, focal, damping = moved, tried, focal * np.exp(step), damping / 3
        if before - after <= MIN_GAIN * before:
            break
    held, pulls = np.array([eliminate(A, b, 0.0)[:2] for _, A, b in systems]).T
    pulls = np.bincount([pair.stretch for pair in pairs], pulls)
    return float(focal), float(focal * np.sqrt((pulls**2).sum()) / held.sum())


def with_motion(pair: Pair, focal: float, center: Float[np.ndarray, " 2"]) -> Pair:
    """The pair with the motion that its F is of, under a focal length."""
    K = camera_matrix(focal, center)
    left, _, right = np.linalg.svd(K.T @ pair.F @ K)
    E = left @ np.diag([1.0, 1.0, 0.0]) @ right
    _, R, t, _ = cv2.recoverPose(E, *pair.pixels, K)
    return replace(pair, T=np.hstack([R, t]))


def normal_equations(
    pair: Pair, focal: float, center: Float[np.ndarray, " 2"]
) -> tuple[float, Float[np.ndarray, "6 6"], Float[np.ndarray, " 6"]]:
    """Robust cost (Cauchy), Gauss-Newton matrix and gradient in log f and five numbers of the motion."""
    residuals = sampson(pair, focal, center)
    moved = [sampson(pair, focal * np.exp(DIFFERENCE), center)]
    moved += [sampson(moved_by(pair, DIFFERENCE * axis), focal, center) for axis in np.eye(5)]
    jacobian = (np.stack(moved, axis=-1) - residuals[:, None]) / DIFFERENCE
    weights = 1 / (1 + (residuals / MAX_EPIPOLAR_ERROR) ** 2)
    cost = -np.log(weights).sum() * MAX_EPIPOLAR_ERROR**2
    weighted = jacobian * weights[:, None]
    return float(cost), np.einsum("mi,mj->ij", weighted, jacobian), np.einsum("mi,m->i", weighted, residuals)


def eliminate(A: Float[np.ndarray, "6 6"], b: Float[np.ndarray, " 6"], damping: float):
    """Eliminate a pair's motion: return curvature and gradient by log f, and the motion's step for a step of log f."""
    block = A[1:, 1:] + np.diag(damping * A[1:, 1:].diagonal() + 1e-9 * max(A[1:, 1:].trace(), 1e-30))
    solved = np.linalg.solve(block, np.stack([A[1:, 0], b[1:]], axis=-1))
    curvature, gradient = A[0, 0] - A[0, 1:] @ solved[:, 0], b[0] - A[0, 1:] @ solved[:, 1]
    return curvature, gradient, lambda step: -solved[:, 1] - solved[:, 0] * step


def moved_by(pair: Pair, step: Float[np.ndarray, " 5"]) -> Pair:
    """The pair with its rotation turned by step[:3] and the direction of its translation by step[3:]."""
    R, t = pair.T[:, :3], pair.T[:, 3]
    aside = np.linalg.svd(t[None])[2][1:]  # two directions across t
    t = t + step[3:] @ aside
    return replace(pair, T=np.column_stack([Rotation.from_rotvec(step[:3]).as_matrix() @ R, t / np.linalg.norm(t)]))


def sampson(pair: Pair, focal: float, center: Float[np.ndarray, " 2"]) -> Float[np.ndarray, " m"]:
    """Signed first-order distance in pixels of each match to the epipolar geometry of the pair's motion."""
    inverse = np.linalg.inv(camera_matrix(focal, center))
    x, y, z = pair.T[:, 3]
    F = inverse.T @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ pair.T[:, :3] @ inverse
    a, b = (np.column_stack([pixels, np.ones(len(pixels))]) for pixels in pair.pixels)
    lines_b, lines_a = a @ F.T, b @ F
    length = np.sqrt((lines_b[:, :2] ** 2).sum(axis=1) + (lines_a[:, :2] ** 2).sum(axis=1))
    return (b * lines_b).sum(axis=1) / np.maximum(length, 1e-30)


def describe(found: FocalLength) -> str:
    """One line for people."""
    lower, upper = found.quartiles
    return (
        f"estimated from {found.num_pairs} pairs of {found.num_images} images: focal length {found.value:.1f} px, "
        f"standard deviation {found.spread:.1f}; half of the single pairs say {lower:.0f} to {upper:.0f}"
    )

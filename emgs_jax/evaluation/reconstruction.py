"""Compare a reconstructed cloud with the true one: accuracy, completion, F1, normals."""

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from emgs_jax.data.backprojection import backproject
from emgs_jax.data.base import Frame
from emgs_jax.evaluation.clouds import (
    PART_ROWS,
    NearestPoints,
    PointCloud,
    SpooledCloud,
    VoxelMeans,
    coarse_points,
    fuse_clouds,
    register,
    spooled,
    transform_cloud,
)
from emgs_jax.evaluation.trajectory import align_poses
from emgs_jax.geometry import Sim3
from emgs_jax.ops.ranges import number, one_of

Metrics = dict[str, float | int | str | None]
_BAND_ROWS = 40  # of an image whose normals are fitted at a time, so that intermediate values stay in the cache


@dataclass(frozen=True)
class EvaluationConfig:
    """The protocol of a comparison, which is written into every result. Values: conf/evaluation."""

    protocol: str
    alignment: str = one_of("sim3", "se3", default="sim3")  # se3: without the scale
    statistic: str = one_of("mean", "rmse", default="mean")  # of the distances
    max_distance_m: float = number(math.inf, low=1e-6, high=math.inf)  # clips distances, but not for F1
    max_depth_m: float = number(math.inf, low=1e-6, high=math.inf)  # true depth farther away is left out
    icp_distance_m: float = number(0.0, low=0)  # of pairs of ICP after the alignment; 0: no ICP
    placement_icp_m: float = number(0.1, low=1e-6)  # likewise for reconstruction_icp/…, whatever the protocol
    icp_voxel_m: float = number(0.05, low=1e-4)  # a grid has 2^20 cells to each side of the origin
    icp_max_steps: int = number(30, low=0, high=10000)
    voxel_m: float = number(0.01, low=1e-4)
    max_points: int | None = number(None, low=1, high=1e9)  # compare a random choice of so many points of each cloud
    num_sampled: int = number(400000, low=1, high=1e9)  # points of either cloud with a distance to all of the other
    f1_thresholds_m: tuple[float, ...] = number((0.2, 0.05), low=1e-9)
    max_normal_angle_deg: float = number(30.0, low=0, high=180)
    normal_radius_px: int = number(4, low=1, high=64)
    normal_step_px: int = number(2, low=1, high=64)
    max_normal_gap: float = number(0.1, low=0, high=math.inf)  # relative inverse-depth step to a tap of the window
    max_normal_residual: float = number(0.02, low=0, high=math.inf)  # likewise, from a tap to the fitted plane
    min_normal_taps: int = number(8, low=3, high=1000)
    label_neighbours: int = number(5, low=1, high=1000)  # nearest points of the map that vote for a label


def window_normals(points: np.ndarray, valid: np.ndarray, config: EvaluationConfig) -> np.ndarray:
    """Unit normals (h, w, 3) towards the camera, of planes in windows of a point map; float32, zero without a plane.

    On a plane the inverse depth is affine in (x/z, y/z). The first of two weighted least-squares passes takes taps
    without a depth step to the centre, the second those near the first plane.
    """
    valid = valid & np.isfinite(points).all(-1) & (points[..., 2] > 1e-6)
    z = np.where(valid, points[..., 2], 1.0).astype(np.float32)
    samples = np.stack([points[..., 0] / z, points[..., 1] / z, 1.0 / z]).astype(np.float32)
    samples = np.where(valid, samples, 0.0)
    slopes, offset = np.zeros_like(samples[:2]), np.zeros_like(z)
    for max_gap in (config.max_normal_gap, config.max_normal_residual):
        slopes, offset, good = _fit_planes(samples, valid, slopes, offset, max_gap * samples[2], config)
    # samples[2] + offset is the plane's inverse depth at the centre: (slopes, c) · p = 1 for every p on the plane.
    c = samples[2] + offset - slopes[0] * samples[0] - slopes[1] * samples[1]
    normals = -np.stack([slopes[0], slopes[1], c], -1)
    length = np.linalg.norm(normals, axis=-1)
    good &= valid & (samples[2] + offset > 0) & (length > 1e-12)
    return np.where(good[..., None], normals / np.where(good, length, 1.0)[..., None], 0.0)


def camera_cloud(points: np.ndarray, mask: np.ndarray, image: np.ndarray, config: EvaluationConfig) -> PointCloud:
    """Turn a point map (h, w, 3) and its image, uint8 (h, w, 3), into a cloud, all in the camera's frame."""
    mask = mask & np.isfinite(points).all(-1)
    normals = window_normals(points, mask, config)[mask].astype(np.float64)
    return PointCloud(points[mask].astype(np.float64), normals, image[mask] / 255.0)


def posed(cloud: PointCloud, T_world_camera: np.ndarray) -> PointCloud:
    """Move a cloud from a camera's frame to the world's."""
    return transform_cloud(cloud, Sim3(1.0, T_world_camera[:3, :3], T_world_camera[:3, 3]))


def ground_truth_cloud(
    frames: Iterable[Frame], intrinsics: tuple[float, float, float, float], config: EvaluationConfig
) -> PointCloud:
    """Back-project true depth by true poses; frames without them contribute nothing."""

    def clouds():
        for frame in frames:
            if frame.depth is not None and frame.T_world_camera is not None:
                depth = frame.static_depth
                known = (depth > 0) & (depth <= config.max_depth_m)
                cloud = camera_cloud(backproject(depth, intrinsics), known, frame.image, config)
                yield posed(cloud, frame.T_world_camera)

    return fuse_clouds(clouds(), config.voxel_m)


@dataclass(frozen=True)
class Reference:
    """The true cloud, prepared once for all comparisons."""

    cloud: PointCloud  # averaged per voxel
    points: NearestPoints
    icp_points: NearestPoints


def reference(truth: PointCloud, config: EvaluationConfig) -> Reference:
    """Prepare a true cloud, of one point a voxel, for comparisons under a protocol, with and without ICP."""
    coarse = coarse_points([truth.points], config.icp_voxel_m)
    return Reference(truth, NearestPoints(truth.points), NearestPoints(coarse))


def compare_clouds(
    cloud: PointCloud | SpooledCloud, truth: Reference, poses: tuple[np.ndarray, np.ndarray], config: EvaluationConfig
) -> Metrics:
    """Align the estimate's cloud with the truth by the protocol and compare both, see `compare_placements`."""
    return compare_placements(cloud, truth, poses, config, [config.icp_distance_m])[0]


def compare_placements(
    cloud: PointCloud | SpooledCloud,
    truth: Reference,
    poses: tuple[np.ndarray, np.ndarray],
    config: EvaluationConfig,
    icp_distances_m: Sequence[float],
) -> list[Metrics]:
    """Compare the estimate's cloud, aligned by its poses and then by ICP with each of these distances (0: no ICP).

    Poses are the estimated and the true ones (n, 4, 4), see `align_poses`. A `SpooledCloud` is first averaged by voxels
    of the truth's `voxel_m`, whatever its unit. ICP keeps the scale.
    """
    alignment, note = align_poses(*poses, with_scale=config.alignment == "sim3")
    is_spooled = isinstance(cloud, SpooledCloud)
    own = cloud.averaged(own_voxel(alignment, config)) if is_spooled else [cloud]
    precision = np.float32 if is_spooled else np.float64
    source = coarse_points((alignment.apply(part.points) for part in own), config.icp_voxel_m)
    found: dict[float, Metrics] = {}
    for distance in {*icp_distances_m}:
        placed = _moved(source, truth, distance, config) @ alignment
        moved = spooled((transform_cloud(part, placed) for part in own), precision, has_colors=False)
        means = moved.averaged(config.voxel_m)
        found[distance] = compare_means(means, truth, config) | {"reconstruction/alignment_note": note}
    return [found[distance] for distance in icp_distances_m]


def own_voxel(alignment: Sim3, config: EvaluationConfig) -> float:
    """`voxel_m` in the unit of the estimate."""
    return config.voxel_m / alignment.scale if alignment.scale > 0 else config.voxel_m


def align_points(
    points: np.ndarray, truth: Reference, poses: tuple[np.ndarray, np.ndarray], config: EvaluationConfig
) -> np.ndarray:
    """Move points (n, 3) of the estimate as `compare_clouds` moves its cloud."""
    alignment, _ = align_poses(*poses, with_scale=config.alignment == "sim3")
    if config.icp_distance_m == 0:
        return alignment.apply(points)
    parts = (alignment.apply(points[row : row + PART_ROWS]) for row in range(0, len(points), PART_ROWS))
    source = coarse_points(parts, config.icp_voxel_m)
    return (_moved(source, truth, config.icp_distance_m, config) @ alignment).apply(points)


def _moved(source: np.ndarray, truth: Reference, distance: float, config: EvaluationConfig) -> Sim3:
    """The motion of coarse points (n, 3) onto the truth by ICP; the identity for a distance of 0."""
    return register(source, truth.icp_points, distance, config.icp_max_steps if distance > 0 else 0)


def compare_means(means: VoxelMeans, truth: Reference, config: EvaluationConfig) -> Metrics:
    """Compare an averaged cloud with the truth; flat keys, metres and percent; None, with a reason, if one is empty.

    Accuracy (estimate → truth) and completion (truth → estimate) are the protocol's statistic of the distances to the
    nearest point, from `num_sampled` points, evenly spread over the voxels, to all of the other cloud. Metrics of
    normals take |cos| of nearest neighbours and average both directions.
    """
    if not len(means) or not len(truth.cloud):
        which = "ground truth" if len(means) else "estimate"
        return not_compared(config, f"the {which} has no points", len(means))
    rng = np.random.default_rng(0)  # one generator: equally long clouds must not keep the same rows
    is_whole = config.max_points is None
    rows = _spread(len(means), config.num_sampled, rng) if is_whole else _choice(len(means), config.max_points, rng)
    some, kept = means.rows(rows), _choice(len(truth.cloud), config.max_points, rng)
    parts = means.tables() if is_whole and len(some) < len(means) else ()
    normals, of_truth = truth.cloud.normals[kept], truth.points
    if len(kept) < len(truth.cloud):
        of_truth = NearestPoints(truth.cloud.points[kept])
    asked = _spread(len(of_truth), config.num_sampled, rng) if is_whole else slice(None)
    to_estimate, seen = _nearest_means(parts, some, of_truth.points[asked])
    to_truth, partners = (values[:, 0] for values in of_truth.query(some[:, :3]))
    cosines = _abs_cosines(some[:, 3:6], normals[partners]), _abs_cosines(seen, normals[asked])
    scores = _scores((to_truth, to_estimate), cosines, config)
    return dict.fromkeys(_metric_names(config)) | {"reconstruction/num_points": len(means)} | scores


def not_compared(config: EvaluationConfig, reason: str, num_points: int | None = None) -> Metrics:
    """The keys of a comparison without values, and the reason."""
    found: Metrics = dict.fromkeys(_metric_names(config))
    return found | {"reconstruction/num_points": num_points, "reconstruction/reason": reason}


def _scores(distances: Sequence[np.ndarray], cosines: Sequence[np.ndarray], config: EvaluationConfig) -> Metrics:
    """Metrics of distances and of |cos| of normals, each from the estimate to the truth and back."""
    values = [_average(both, config) for both in distances]
    for threshold in config.f1_thresholds_m:
        precision, recall = (100.0 * np.mean(both <= threshold) for both in distances)
        f1 = 2.0 * precision * recall / max(precision + recall, 1e-12)
        values += [float(f1), float(precision), float(recall)]
    reason: Metrics = {"reconstruction/reason": "no normals to compare"}
    if all(map(len, cosines)):
        limit, reason = np.cos(np.radians(config.max_normal_angle_deg)), {}
        values.append(100.0 * float(np.mean([both.mean() for both in cosines])))
        values.append(100.0 * float(np.mean([(both >= limit).mean() for both in cosines])))
    return reason | dict(zip(_metric_names(config), values, strict=False))


def _nearest_means(parts: Iterable[np.ndarray], some: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each point (m, 3) to the nearest mean, and the normal (m, 3) there.

    `some` (n, 7) of all parts bound the distances: a part is searched only for points that it may be nearer to.
    """
    distances, rows = (values[:, 0] for values in NearestPoints(some[:, :3]).query(points))
    normals, x = some[rows, 3:6], points[:, 0]
    for part in parts:
        # Parts are sorted along the first axis.
        near = np.flatnonzero(np.maximum(part[:, 0].min() - x, x - part[:, 0].max()) < distances)
        nearer, rows = (values[:, 0] for values in NearestPoints(part[:, :3]).query(points[near]))
        closer = nearer < distances[near]
        distances[near[closer]], normals[near[closer]] = nearer[closer], part[rows[closer], 3:6]
    return distances, normals


def _average(distances: np.ndarray, config: EvaluationConfig) -> float:
    clipped = np.minimum(distances, config.max_distance_m)
    return float(clipped.mean() if config.statistic == "mean" else np.sqrt(np.mean(np.square(clipped))))


def _choice(count: int, at_most: int | None, rng: np.random.Generator) -> np.ndarray:
    """Ascending numbers below `count`: all, or a random choice of `at_most`."""
    if at_most is None or count <= at_most:
        return np.arange(count)
    return np.sort(rng.choice(count, at_most, replace=False))


def _spread(count: int, at_most: int, rng: np.random.Generator) -> np.ndarray:
    """Likewise, a random one of each of `at_most` equal ranges."""
    if count <= at_most:
        return np.arange(count)
    return ((np.arange(at_most) + rng.random(at_most)) * (count / at_most)).astype(np.int64)


def _metric_names(config: EvaluationConfig) -> list[str]:
    names = ["accuracy_m", "completion_m"]
    for threshold in config.f1_thresholds_m:
        names += [f"{kind}_{100 * threshold:g}cm_percent" for kind in ("f1", "precision", "recall")]
    names += ["normals_abs_cos_percent", f"normals_within_{config.max_normal_angle_deg:g}deg_percent"]
    return [f"reconstruction/{name}" for name in names]


def _abs_cosines(normals: np.ndarray, others: np.ndarray) -> np.ndarray:
    known = normals.any(axis=1) & others.any(axis=1)
    return np.abs(np.einsum("ni,ni->n", normals[known], others[known]))


def _fit_planes(
    samples: np.ndarray,
    valid: np.ndarray,
    slopes: np.ndarray,
    offset: np.ndarray,
    gap: np.ndarray,
    config: EvaluationConfig,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit inverse depth = centre's + offset + slopes · (ray − centre's ray) around every pixel of samples (3, h, w).

    Takes the taps within `gap` (h, w) of the given planes. Returns slopes (2, h, w), offset (h, w), and where enough
    taps lay in both directions.
    """
    (_, h, w), radius = samples.shape, config.normal_radius_px
    padded, is_valid = np.pad(samples, ((0, 0), (radius, radius), (radius, radius))), np.pad(valid, radius)
    shifts, sums = range(0, 2 * radius + 1, config.normal_step_px), np.zeros((9, h, w), np.float32)
    for top in range(0, h, _BAND_ROWS):
        band = slice(top, min(top + _BAND_ROWS, h))
        for row, column in itertools.product(shifts, shifts):
            window = slice(band.start + row, band.stop + row), slice(column, column + w)
            x, y, d = padded[:, *window] - samples[:, band]
            distance = np.abs(d - offset[band] - slopes[0, band] * x - slopes[1, band] * y)
            keep = is_valid[window] & (distance <= gap[band])
            x, y, d = x * keep, y * keep, d * keep
            for total, term in zip(sums[:, band], (keep, x, y, d, x * x, x * y, y * y, x * d, y * d), strict=True):
                total += term
    count = np.maximum(sums[0], 1.0)
    x, y, d, xx, xy, yy, xd, yd = sums[1:] / count
    xx, xy, yy, xd, yd = xx - x * x, xy - x * y, yy - y * y, xd - x * d, yd - y * d
    determinant = xx * yy - xy * xy
    good = (sums[0] >= config.min_normal_taps) & (determinant > 1e-3 * (xx + yy) ** 2)
    scale = np.where(good, 1.0 / np.where(good, determinant, 1.0), 0.0)
    a, b = (yy * xd - xy * yd) * scale, (xx * yd - xy * xd) * scale
    return np.stack([a, b]), d - a * x - b * y, good

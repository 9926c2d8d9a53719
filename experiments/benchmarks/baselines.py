"""Host-side alternatives that a user would write or pick instead of the library: the same mathematics on arrays."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

Arrays = Mapping[str, np.ndarray]  # the fields of Gaussians or of an Observation, valid rows only


@dataclass(frozen=True)
class Update:
    """Result of `em`: neighbours and responsibilities (m, k), and the new parameters of the Gaussians, by name."""

    rows: np.ndarray
    responsibilities: np.ndarray
    parameters: dict[str, np.ndarray]


def em(gaussians: Arrays, points: Arrays, noise: np.ndarray, config: Any) -> Update:
    """E-step and M-step of eq. 2 to 4 with NumPy, SciPy's k-d tree and a sparse matrix product.

    Args:
        points: m of them, in the same frame.
        noise: (m, 3), as in `emgs_jax.em.e_step`.
    """
    tree = cKDTree(gaussians["means"])
    _, rows = tree.query(points["points"], config.num_neighbours, workers=-1)
    precisions, logdets = np.linalg.inv(gaussians["covs"]), np.linalg.slogdet(gaussians["covs"])[1]
    offsets = points["points"][:, None] - gaussians["means"][rows]
    near = precisions[rows]
    nu = float(config.noise) * noise
    pulled = np.einsum("mkij,mj->mki", near, nu)
    growth = 1.0 + np.einsum("mki,mi->mk", pulled, nu)
    distance_sq = np.einsum("mki,mkij,mkj->mk", offsets, near, offsets, optimize=True)
    distance_sq -= np.einsum("mki,mki->mk", offsets, pulled) ** 2 / growth
    determinant = -float(config.determinant_weight) * (logdets[rows] + np.log(growth))
    cosine = np.einsum("mkd,md->mk", gaussians["normals"][rows], points["normals"])
    joint = -0.5 * distance_sq + determinant + float(config.normal_weight) * (cosine - 1.0)
    if gaussians["features"].shape[1]:
        lengths = np.maximum(np.linalg.norm(gaussians["features"], axis=1, keepdims=True), 1e-12)
        alike = np.einsum("mkf,mf->mk", (gaussians["features"] / lengths)[rows], points["features"])
        joint += float(config.feature_weight) * (alike - 1.0)
    best = joint.max(axis=1)
    is_fused = (cosine.mean(axis=1) >= float(config.min_normal_cos)) & (
        distance_sq.min(axis=1) <= float(config.max_mahalanobis_sq)
    )
    is_fused &= determinant.max(axis=1) - best <= float(config.max_log_gap)
    weights = np.exp(joint - best[:, None])
    r = weights / weights.sum(axis=1, keepdims=True) * is_fused[:, None]
    return Update(rows, r, _m_step(gaussians, points, rows, r, config))


def _m_step(gaussians: Arrays, points: Arrays, rows: np.ndarray, r: np.ndarray, config: Any) -> dict[str, np.ndarray]:
    m, k = r.shape
    assign = csr_array((r.ravel(), rows.ravel(), np.arange(0, m * k + 1, k)), shape=(m, len(gaussians["means"]))).T
    x = points["points"].astype(np.float64)  # second moments about the origin cancel in float32
    products = (x[:, :, None] * x[:, None]).reshape(m, 9)
    sums = assign @ np.concatenate([np.ones((m, 1)), x, products, points["normals"], points["colors"]], axis=1)
    total = sums[:, 0]
    has_points = total > float(config.min_responsibility)
    mean = sums / np.where(has_points, total, 1.0)[:, None]
    covs = mean[:, 4:13].reshape(-1, 3, 3) - mean[:, 1:4, None] * mean[:, None, 1:4]
    covs += float(config.min_std) ** 2 * np.eye(3)
    normals = mean[:, 13:16] / np.maximum(np.linalg.norm(mean[:, 13:16], axis=1, keepdims=True), 1e-12)
    new = {"means": mean[:, 1:4], "covs": covs, "normals": normals, "colors": mean[:, 16:]}
    keep = {name: has_points.reshape(-1, *[1] * (value.ndim - 1)) for name, value in new.items()}
    return {name: np.where(keep[name], value, gaussians[name]) for name, value in new.items()}


def colored_icp(source: Arrays, target: Arrays, start: np.ndarray, reach: float, num_steps: int) -> np.ndarray:
    """Open3D's coloured ICP for exactly `num_steps` iterations; T_target_source (4, 4).

    Args:
        source: points and colors.
        target: points, normals and colors.
        start: T_target_source (4, 4).
        reach: m; farther points are no pair.
    """
    import open3d

    registration = open3d.pipelines.registration
    clouds = []
    for arrays in (source, target):
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(arrays["points"]))
        cloud.colors = open3d.utility.Vector3dVector(arrays["colors"])
        cloud.normals = open3d.utility.Vector3dVector(arrays["normals"])
        clouds.append(cloud)
    estimation = registration.TransformationEstimationForColoredICP()
    criteria = registration.ICPConvergenceCriteria(0.0, 0.0, num_steps)
    return registration.registration_colored_icp(*clouds, reach, start, estimation, criteria).transformation


def render(
    splats: Arrays, values: np.ndarray, width: int, lines: Sequence[int], config: Any, xp: Any = np
) -> np.ndarray:
    """Front-to-back compositing of every splat at every pixel, without tiles; `values` (n, v) -> (lines, w, v).

    Args:
        splats: means (n, 2), precisions (n, 2, 2), depth (n,): those in front of the camera.
        lines: of the image that are drawn.
        xp: numpy, or torch with tensors.
    """
    order = xp.argsort(splats["depth"])
    means, values = splats["means"][order], values[order]
    a, b, c = (splats["precisions"][order][:, i, j][:, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    columns, drawn = xp.arange(width), []
    for row in lines:  # a line of the image at once bounds the memory
        dx, dy = columns[None] - means[:, :1], row - means[:, 1:]
        distance_sq = a * dx**2 + 2.0 * b * dx * dy + c * dy**2
        alpha = float(config.opacity) * xp.exp(-0.5 * distance_sq) * (distance_sq <= float(config.radius) ** 2)
        light = xp.cumprod(1.0 - alpha, 0)
        light = xp.concatenate([xp.ones_like(light[:1]), light[:-1]])
        drawn.append((alpha * light).T @ values)
    return xp.stack(drawn)


def render_gsplat(gaussians: Any, values: Any, T_camera_world: Any, intrinsics: Any, size: tuple[int, int]) -> Any:
    """gsplat's rasterisation of means, quaternions, standard deviations and opacities; all are CUDA tensors."""
    import gsplat

    image, _, _ = gsplat.rasterization(*gaussians, values, T_camera_world[None], intrinsics[None], *size)
    return image[0]

"""Slow, readable NumPy truth in float64: what the paper's equations say, one item at a time."""

import numpy as np


def knn(queries, points, valid, k):
    """Distances (m, k) of the k nearest valid points, ascending; inf where there are fewer."""
    result = np.full((len(queries), k), np.inf)
    for i, query in enumerate(np.asarray(queries, float)):
        distances = np.sort(np.linalg.norm(np.asarray(points, float)[np.asarray(valid)] - query, axis=-1))[:k]
        result[i, : len(distances)] = distances
    return result


def nearest_rows(query, points, valid, k):
    distance = np.where(valid, np.linalg.norm(np.asarray(points, float) - query, axis=-1), np.inf)
    rows = np.argsort(distance, kind="stable")[:k]
    return rows[np.isfinite(distance[rows])]


def lloyd(points, seeds, num_iterations):
    """k-means; an empty cluster keeps its centroid. Returns centroids and the counts of the last assignment."""
    centroids, counts = np.array(seeds, float), np.ones(len(seeds))
    for _ in range(num_iterations):
        nearest = np.argmin(np.linalg.norm(points[:, None] - centroids, axis=-1), axis=1)
        counts = np.bincount(nearest, minlength=len(centroids)).astype(float)
        for k in np.flatnonzero(counts):
            centroids[k] = points[nearest == k].mean(axis=0)
    return centroids, counts


def fit_to_points(center, points, normals, colors, features, num_neighbours, min_std):
    """Eq. 1 for one centre: covariance, normal, colour and medoid feature of its nearest points."""
    rows = nearest_rows(center, points, np.ones(len(points), bool), num_neighbours)
    x = points[rows]
    cov = np.cov(x.T, bias=True) + min_std**2 * np.eye(3)
    weights = np.array([np.exp(-0.5 * (p - center) @ np.linalg.inv(cov) @ (p - center)) for p in x])
    share = weights / weights.sum()
    normal = share @ normals[rows]
    mean_feature = share @ features[rows]
    medoid = rows[np.argmax(features[rows] @ mean_feature)]
    return cov, normal / np.linalg.norm(normal), share @ colors[rows], features[medoid]


def log_joint(point, normal, feature, g, rows, determinant_weight, normal_weight, feature_weight):
    """Eq. 3 for one point: log-joint and determinant term for the Gaussians `rows`; d² is squared once (R1)."""
    joint, determinant = [], []
    for k in rows:
        offset = point - g["means"][k]
        determinant.append(-determinant_weight * np.linalg.slogdet(g["covs"][k])[1])
        value = -0.5 * offset @ np.linalg.inv(g["covs"][k]) @ offset + determinant[-1]
        value += normal_weight * (g["normals"][k] @ normal - 1.0)
        if len(feature):
            value += feature_weight * (g["features"][k] @ feature - 1.0)
        joint.append(value)
    return np.array(joint), np.array(determinant)


def e_step(points, normals, features, g, config):
    """Eq. 2 and 3: responsibilities as a dense (m, n) matrix, zero outside the K neighbours, and who is fused."""
    m, n = len(points), len(g["means"])
    responsibilities, is_fused = np.zeros((m, n)), np.zeros(m, bool)
    for i in range(m):
        rows = nearest_rows(points[i], g["means"], np.ones(n, bool), config.num_neighbours)
        weights = float(config.determinant_weight), float(config.normal_weight), float(config.feature_weight)
        joint, determinant = log_joint(points[i], normals[i], features[i], g, rows, *weights)
        offsets = points[i] - g["means"][rows]
        distance_sq = [o @ np.linalg.inv(g["covs"][k]) @ o for o, k in zip(offsets, rows, strict=True)]
        is_fused[i] = np.mean(g["normals"][rows] @ normals[i]) >= config.min_normal_cos
        is_fused[i] &= min(distance_sq) <= config.max_mahalanobis_sq
        is_fused[i] &= determinant.max() - joint.max() <= config.max_log_gap
        exponent = np.exp(joint - joint.max())
        responsibilities[i, rows] = exponent / exponent.sum() * is_fused[i]
    return responsibilities, is_fused


def m_step(responsibilities, points, normals, colors, k, min_std):
    """Mean, covariance about it, normal and colour of the points of Gaussian k, weighted by their responsibility."""
    share = responsibilities[:, k] / responsibilities[:, k].sum()
    mean = share @ points
    cov = (share[:, None] * (points - mean)).T @ (points - mean) + min_std**2 * np.eye(3)
    normal = share @ normals
    return mean, cov, normal / np.linalg.norm(normal), share @ colors


def support(responsibilities, points, mean, cov, normal, k, kind):
    """δ_k: for both principal axes of the covariance within the tangent plane, 2 min of the two sides' sums (R5)."""
    projector = np.eye(3) - np.outer(normal, normal)
    axes = np.linalg.eigh(projector @ cov @ projector)[1][:, 1:]  # the smallest eigenvalue, 0, is the normal's
    scores = []
    for axis in axes.T:
        is_positive = (points - mean) @ axis > 0
        plus, minus = responsibilities[is_positive, k].sum(), responsibilities[~is_positive, k].sum()
        smaller = 2 * min(plus, minus)
        scores.append(smaller / (plus + minus) if kind == "normalized" else min(smaller, 1.0))
    return min(scores)


def running_average(values, start, evidence, gain):
    """Eq. 4 over a sequence of scalars from α_0 = W_0 = 1; returns the average after each."""
    average, weight, result = start, 1.0, []
    for value, delta in zip(values, evidence, strict=True):
        alpha = delta / (weight + delta)
        average = (1 - alpha) * average + alpha * value
        weight = alpha if gain == "ema_printed" else weight + delta
        result.append(average)
    return result


def umeyama(source, target, weights):
    """Rotation, translation and scale of the weighted least-squares similarity (Umeyama 1991)."""
    share = weights / weights.sum()
    a, b = source - share @ source, target - share @ target
    u, s, vt = np.linalg.svd((share[:, None] * b).T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ sign @ vt
    scale = np.sum(s * np.diag(sign)) / (share @ np.sum(a**2, axis=1))
    return rotation, share @ target - rotation @ (share @ source), scale


def splat(mean, cov, pose, focal, center, scale, blur):
    """EWA: pixel, image-plane covariance, camera-frame point and covariance of one Gaussian."""
    rotation, translation = pose[:3, :3], pose[:3, 3]
    x, y, z = point = rotation.T @ (mean - translation)
    camera_cov = scale * rotation.T @ cov @ rotation
    jacobian = np.array([[focal[0] / z, 0, -focal[0] * x / z**2], [0, focal[1] / z, -focal[1] * y / z**2]])
    pixel = np.array([focal[0] * x / z + center[0], focal[1] * y / z + center[1]])
    return pixel, jacobian @ camera_cov @ jacobian.T + blur * np.eye(2), point, camera_cov


def render(g, values, pose, camera, config):
    """Every Gaussian at every pixel, nearest first, no tiles: values, alpha, expected depth."""
    focal, center = np.asarray(camera.focal, float), np.asarray(camera.center, float)
    shape = camera.height, camera.width
    light, image, alpha, depth = np.ones(shape), np.zeros((*shape, values.shape[1])), np.zeros(shape), np.zeros(shape)
    scale, radius = float(config.covariance_scale), float(config.radius)
    rows = [k for k in range(len(g["means"])) if g["valid"][k]]
    depth_of = {k: (pose[:3, :3].T @ (g["means"][k] - pose[:3, 3]))[2] for k in rows}
    for k in sorted((k for k in rows if depth_of[k] > 1e-3), key=depth_of.get):
        pixel, cov_2d, point, cov = splat(g["means"][k], g["covs"][k], pose, focal, center, scale, float(config.blur))
        normal, reach = pose[:3, :3].T @ g["normals"][k], radius * np.sqrt(cov[2, 2])
        for row in range(shape[0]):
            for column in range(shape[1]):
                offset = np.array([column, row]) - pixel
                distance_sq = offset @ np.linalg.inv(cov_2d) @ offset
                if distance_sq > radius**2:
                    continue
                weight = light[row, column] * float(config.opacity) * np.exp(-0.5 * distance_sq)
                ray = np.array([(column - center[0]) / focal[0], (row - center[1]) / focal[1], 1.0])
                # In inverse depth: beyond its horizon a plane is infinitely far, not behind the camera.
                # A plane that is seen at a grazing angle (cosine below .1) has its mean's depth everywhere.
                is_grazing = abs(normal @ point) <= 0.1 * np.linalg.norm(point)
                inverse = 1 / point[2] if is_grazing else (normal @ ray) / (normal @ point)
                z = 1 / np.clip(inverse, 1 / (point[2] + reach), 1 / max(point[2] - reach, 0.1 * point[2]))
                image[row, column] += weight * values[k]
                depth[row, column] += weight * z
                alpha[row, column] += weight
                light[row, column] -= weight
    return image, alpha, np.where(alpha >= config.min_alpha, depth / np.maximum(alpha, 1e-9), 0.0)


ROOM_LOW, ROOM_HIGH = np.array([-0.9, -0.7, -0.8]), np.array([1.0, 0.75, 2.2])  # m; a box, seen from inside


def texture(points):
    """A smooth colour in [0, 1] for every world point."""
    phase = points @ np.array([[2.1, 0.9, -1.7], [-1.3, 2.4, 0.8], [1.1, -1.9, 2.2]])
    return 0.5 + 0.4 * np.sin(phase)


def room_view(pose, focal, center, width, height):
    """The box room from `pose` by ray casting: camera-frame points, camera-frame normals and colours, row-major."""
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([(columns - center[0]) / focal[0], (rows - center[1]) / focal[1], np.ones(columns.shape)], -1)
    directions = rays.reshape(-1, 3) @ pose[:3, :3].T
    walls = np.where(directions > 0, ROOM_HIGH, ROOM_LOW)
    with np.errstate(divide="ignore"):
        reach = (walls - pose[:3, 3]) / directions
    axis = np.argmin(reach, axis=1)
    depth = reach[np.arange(len(reach)), axis]
    normals = np.zeros_like(directions)
    normals[np.arange(len(axis)), axis] = -np.sign(directions[np.arange(len(axis)), axis])
    points = rays.reshape(-1, 3) * depth[:, None]
    return points, normals @ pose[:3, :3], texture(points @ pose[:3, :3].T + pose[:3, 3])

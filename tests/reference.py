"""Slow, readable NumPy truth in float64: what the paper's equations say, one item at a time."""

import numpy as np
from scipy.optimize import least_squares


def nearest_rows(query, points, valid, k):
    distance = np.where(valid, np.linalg.norm(np.asarray(points, float) - query, axis=-1), np.inf)
    rows = np.argsort(distance, kind="stable")[:k]
    return rows[np.isfinite(distance[rows])]


def lloyd(points, seeds, num_iterations):
    """k-means; an empty cluster keeps its centroid. Returns centroids and the counts of the last assignment."""
    centroids = np.array(seeds, float)
    for _ in range(max(num_iterations, 1)):
        nearest = np.argmin(np.linalg.norm(points[:, None] - centroids, axis=-1), axis=1)
        counts = np.bincount(nearest, minlength=len(centroids)).astype(float)
        for k in np.flatnonzero(counts):
            centroids[k] = points[nearest == k].mean(axis=0)
    return (centroids if num_iterations else np.array(seeds, float)), counts


def fit_to_points(center, points, normals, colors, features, valid, num_neighbours, min_std):
    """Eq. 1 for one centre: covariance, normal, colour and medoid feature of its nearest valid points."""
    rows = nearest_rows(center, points, valid, num_neighbours)
    x = points[rows]
    cov = np.cov(x.T, bias=True) + min_std**2 * np.eye(3)
    weights = np.array([np.exp(-0.5 * (p - center) @ np.linalg.inv(cov) @ (p - center)) for p in x])
    share = weights / weights.sum()
    normal = share @ normals[rows]
    mean_feature = share @ features[rows]
    medoid = rows[np.argmax(features[rows] @ mean_feature)]
    return cov, normal / np.linalg.norm(normal), share @ colors[rows], features[medoid]


def log_joint(point, normal, feature, noise, g, rows, config):
    """Eq. 3 for one point: log-joint, determinant term and d² for the Gaussians `rows`, widened by the point's noise.

    d² is squared once (R1).
    """
    joint, determinant, distances_sq = [], [], []
    for k in rows:
        offset, cov = point - g["means"][k], g["covs"][k] + np.outer(noise, noise)
        distances_sq.append(offset @ np.linalg.inv(cov) @ offset)
        determinant.append(-float(config.determinant_weight) * np.linalg.slogdet(cov)[1])
        value = -0.5 * distances_sq[-1] + determinant[-1]
        value += float(config.normal_weight) * (g["normals"][k] @ normal - 1.0)
        if feature.any() and g["features"][k].any():  # a missing one is zero, and says nothing
            value += float(config.feature_weight) * (g["features"][k] @ feature - 1.0)
        joint.append(value)
    return np.array(joint), np.array(determinant), np.array(distances_sq)


def e_step(points, normals, features, noise, valid, g, config):
    """Eq. 2 and 3: responsibilities as a dense (m, n) matrix, zero outside the K neighbours, who is fused, and the best
    log-joint of every point. `noise` is along the viewing rays, before the config's factor."""
    m, n = len(points), len(g["means"])
    responsibilities, is_fused, best = np.zeros((m, n)), np.zeros(m, bool), np.zeros(m)
    for i in range(m):
        rows = nearest_rows(points[i], g["means"], g["valid"], config.num_neighbours)
        if not valid[i] or len(rows) == 0:
            continue
        ray = float(config.noise) * noise[i]
        joint, determinant, distances_sq = log_joint(points[i], normals[i], features[i], ray, g, rows, config)
        best[i] = joint.max()
        is_fused[i] = np.mean(g["normals"][rows] @ normals[i]) >= config.min_normal_cos
        is_fused[i] &= distances_sq.min() <= config.max_mahalanobis_sq
        is_fused[i] &= determinant.max() - joint.max() <= config.max_log_gap
        exponent = np.exp(joint - joint.max())
        responsibilities[i, rows] = exponent / exponent.sum() * is_fused[i]
    return responsibilities, is_fused, best


def m_step(responsibilities, points, normals, colors, k, min_std, noise=0.0):
    """Mean, covariance about it, normal and colour of the points of Gaussian k, weighted by their responsibility.

    Of two points the one with the larger `noise` (m) counts less, as the variances of floor and noise together say."""
    share = responsibilities[:, k] / (min_std**2 + np.square(noise))
    share = share / share.sum()
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


def gain_and_weight(weight, evidence, config):
    """α of eq. 4 and what is kept of it (R4)."""
    total = min(float(config.forgetting) * weight, float(config.max_weight)) + evidence
    return evidence / total, total if config.gain > 0 else evidence / total


def running_average(values, start, evidence, gain):
    """Eq. 4 over a sequence of scalars from α_0 = W_0 = 1; returns the average after each."""
    average, weight, result = start, 1.0, []
    for value, delta in zip(values, evidence, strict=True):
        alpha = delta / (weight + delta)
        average = (1 - alpha) * average + alpha * value
        weight = alpha if gain == "ema_printed" else weight + delta
        result.append(average)
    return result


def moved(g, k, new, gain):
    """(1 - α) old + α new of Gaussian k: mean, covariance (linear), normal and colour."""
    old = g["means"][k], g["covs"][k], g["normals"][k], g["colors"][k]
    mean, cov, normal, color = ((1 - gain) * a + gain * b for a, b in zip(old, new, strict=True))
    return mean, cov, normal / np.linalg.norm(normal), color


def em_update(points, normals, features, colors, noise, valid, g, weight, config):
    """{row: (mean, cov, normal, colour, weight)} of the Gaussians that change, who is fused, and the mean log-joint."""
    r, is_fused, best = e_step(points, normals, features, noise, valid, g, config)
    kind, changed = ("printed", "normalized")[int(config.support)], {}
    for k in np.flatnonzero(r.sum(axis=0) > float(config.min_responsibility)):
        along = float(config.noise) * np.linalg.norm(noise, axis=1)
        new = m_step(r, points, normals, colors, k, float(config.min_std), along)
        delta = support(r, points, g["means"][k], g["covs"][k], g["normals"][k], k, kind)
        if delta > 0:
            gain, kept = gain_and_weight(weight[k], delta, config.average)
            changed[k] = (*moved(g, k, new, gain), kept)
    return changed, is_fused, best[is_fused].mean() if is_fused.any() else 0.0


def umeyama(source, target, weights):
    """Rotation, translation and scale of the weighted least-squares similarity (Umeyama 1991)."""
    share = weights / weights.sum()
    a, b = source - share @ source, target - share @ target
    u, s, vt = np.linalg.svd((share[:, None] * b).T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ sign @ vt
    scale = np.sum(s * np.diag(sign)) / (share @ np.sum(a**2, axis=1))
    return rotation, share @ target - rotation @ (share @ source), scale


def rigid_robust(source, target, start, paired):
    """Rotation and translation after three fits, each weighted by 1 / (1 + (distance / (2 median distance))²)."""
    rotation, translation = start[:3, :3], start[:3, 3]
    source, target = source[paired], target[paired]
    for _ in range(3):
        distance = np.linalg.norm(source @ rotation.T + translation - target, axis=1)
        weights = 1 / (1 + (distance / (2 * np.sort(distance)[(len(distance) - 1) // 2])) ** 2)
        rotation, _, _ = umeyama(source, target, weights)
        share = weights / weights.sum()
        translation = share @ target - rotation @ (share @ source)
    return rotation, translation


def color_gradient(k, means, normals, colors, valid, num_neighbours):
    """Slope of the luminance in the tangent plane of Gaussian k: ridge regression over its neighbours."""
    rows = nearest_rows(means[k], means, valid, num_neighbours)
    projector = np.eye(3) - np.outer(normals[k], normals[k])
    offsets = (means[rows] - means[k]) @ projector
    light = colors @ [0.299, 0.587, 0.114]  # ITU-R BT.601
    moments = offsets.T @ offsets
    ridge = 0.01 * np.trace(moments) * projector
    return np.linalg.pinv(moments + ridge, rcond=1e-6) @ offsets.T @ (light[rows] - light[k])


def normal_of_window(points, valid, row, column, taps, max_depth_step):
    """Normal of a pixel's least-squares plane: 1/z = a x + b y + c along the rays (x, y, 1) of its valid neighbours."""
    equations, inverse = [], 1 / points[row, column, 2]
    for y, x in ((row + dy, column + dx) for dy in taps for dx in taps):
        if 0 <= y < points.shape[0] and 0 <= x < points.shape[1] and valid[y, x]:
            near = 1 / points[y, x, 2]
            if abs(near - inverse) <= max_depth_step * inverse:
                equations.append([*(points[y, x] * near), near])
    equations = np.array(equations)
    slopes = np.linalg.lstsq(equations[:, :3], equations[:, 3], rcond=None)[0]
    return -slopes / np.linalg.norm(slopes)


def matched(points, normals, noise, g, gates):
    """Row of every point's Gaussian, nearest under Σ + ν ν', and whether the two agree; `g` holds valid rows only."""
    widened = g["covs"] + (noise[:, :, None] * noise[:, None])[:, None]
    offsets = points[:, None] - g["means"]
    distance_sq = np.einsum("pki,pkij,pkj->pk", offsets, np.linalg.inv(widened), offsets)
    rows = distance_sq.argmin(axis=1)
    cos = np.sum(g["normals"][rows] * normals, axis=1)
    return rows, (distance_sq.min(axis=1) <= gates[0]) & (cos >= gates[1])


def registered(points, normals, light, noise, g, gradients, config, pose_std):
    """The translation that ICP's cost asks for where rotation and scale are held, for matches that do not change.

    Rows of a point: distance to the plane (`colored`), logarithm of its depth over the plane's along its ray (`ray`,
    about a camera that moves with it) or whitened offset (`distribution`), and its intensity. All
    points together weigh as much as 16, for nothing is known of how alike their errors are, against the prior's
    information over the coarse pose's variance.
    """
    residual = ("colored", "distribution", "colored+distribution", "colored+ray")[int(config.residual)]
    rows, is_inlier = matched(
        points, normals, noise, g, (float(config.max_mahalanobis_sq), float(config.min_normal_cos))
    )
    hessian, force = float(config.prior_information) / pose_std**2 * np.eye(3), np.zeros(3)
    share = 16.0 / len(points)
    if residual == "colored+ray":
        return _along_rays(points, light, noise, g, gradients, config, hessian, (rows, is_inlier))
    for i in np.flatnonzero(is_inlier):
        k, nu = rows[i], noise[i]
        offset, normal, gradient = points[i] - g["means"][k], g["normals"][k], gradients[k]
        if residual == "colored":
            information = np.outer(normal, normal) / (normal @ g["covs"][k] @ normal + (normal @ nu) ** 2)
        else:
            information = np.linalg.inv(g["covs"][k] + np.outer(nu, nu))
        hessian, force = hessian + share * information, force - share * information @ offset
        luminance = g["colors"][k] @ [0.299, 0.587, 0.114]
        shade = (luminance + gradient @ offset - light[i]) / float(config.color_std)
        if residual != "distribution" and abs(shade) < np.sqrt(float(config.max_mahalanobis_sq)):
            hessian = hessian + share * np.outer(gradient, gradient) / float(config.color_std) ** 2
            force = force - share * shade * gradient / float(config.color_std)
    return np.linalg.solve(hessian, force)


def _along_rays(points, light, noise, g, gradients, config, information, matches):
    """The same by a general solver, since the rows are no linear ones."""
    share, edge = 16.0 / len(points), np.sqrt(float(config.max_mahalanobis_sq))

    def rows(x):
        found = list(np.sqrt(information.diagonal()) * x)
        for i in np.flatnonzero(matches[1]):
            k, sigma = matches[0][i], np.linalg.norm(noise[i]) / np.linalg.norm(points[i])
            normal, mean = g["normals"][k], g["means"][k]
            reached = points[i] * (normal @ (mean - x)) / (normal @ points[i])  # where the ray meets the plane
            thickness = normal @ g["covs"][k] @ normal / (normal @ reached) ** 2
            found.append(np.sqrt(share) * np.log(points[i][2] / reached[2]) / np.sqrt(sigma**2 + thickness))
            luminance = g["colors"][k] @ [0.299, 0.587, 0.114]
            shade = (luminance + gradients[k] @ (points[i] + x - mean) - light[i]) / float(config.color_std)
            found.append(np.sqrt(share) * np.clip(shade, -edge, edge))
        return found

    return least_squares(rows, np.zeros(3), xtol=1e-12, ftol=1e-12, gtol=1e-12).x


def splat(mean, cov, pose, camera, scale, blur):
    """EWA: pixel, image-plane covariance, camera-frame point and covariance of one Gaussian.

    The Jacobian is taken at most .3 of the image's size outside of it.
    """
    focal, center = np.asarray(camera.focal, float), np.asarray(camera.center, float)
    size = np.array([camera.width, camera.height])
    rotation, translation = pose[:3, :3], pose[:3, 3]
    x, y, z = point = rotation.T @ (mean - translation)
    camera_cov = scale * rotation.T @ cov @ rotation
    pixel = focal * [x / z, y / z] + center
    tangent = (np.clip(pixel, -0.3 * size, 1.3 * size) - center) / focal
    jacobian = np.array([[focal[0] / z, 0, -focal[0] * tangent[0] / z], [0, focal[1] / z, -focal[1] * tangent[1] / z]])
    return pixel, jacobian @ camera_cov @ jacobian.T + blur * np.eye(2), point, camera_cov


def is_drawn(mean, cov, normal, pose, scale):
    """Whether a Gaussian lies before the camera by two standard deviations, and not with its normal away (cos .1)."""
    rotation = pose[:3, :3]
    point = rotation.T @ (mean - pose[:3, 3])
    depth_std = np.sqrt(scale * (rotation.T @ cov @ rotation)[2, 2])
    return point[2] > max(1e-3, 2 * depth_std) and normal @ rotation @ point <= 0.1 * np.linalg.norm(point)


def plane_depth(pixel, point, normal, reach, camera):
    """Depth at pixels (*b, 2) of the plane through a camera-frame point, kept within `reach` of the point's own."""
    ray = (pixel - np.asarray(camera.center, float)) / np.asarray(camera.focal, float)
    ray = np.concatenate([ray, np.ones((*ray.shape[:-1], 1))], axis=-1)
    # In inverse depth: beyond its horizon a plane is infinitely far, not behind the camera.
    # A plane that is seen at a grazing angle (cosine below .1) has its mean's depth everywhere.
    is_grazing = abs(normal @ point) <= 0.1 * np.linalg.norm(point)
    inverse = 1 / point[2] if is_grazing else (ray @ normal) / (normal @ point)
    return 1 / np.clip(inverse, 1 / (point[2] + reach), 1 / max(point[2] - reach, 0.1 * point[2]))


def render(g, values, pose, camera, config):
    """Every Gaussian at every pixel, nearest first, no tiles: values, alpha, mean and standard deviation of depth."""
    shape = camera.height, camera.width
    light, image, alpha, depth = np.ones(shape), np.zeros((*shape, values.shape[1])), np.zeros(shape), np.zeros(shape)
    depth_sq, scale, radius = np.zeros(shape), float(config.covariance_scale), float(config.radius)
    pixels = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=-1).astype(float)
    rows = [k for k in range(len(g["means"])) if g["valid"][k]]
    rows = [k for k in rows if is_drawn(g["means"][k], g["covs"][k], g["normals"][k], pose, scale)]
    depth_of = {k: (pose[:3, :3].T @ (g["means"][k] - pose[:3, 3]))[2] for k in rows}
    for k in sorted(rows, key=depth_of.get):
        pixel, cov_2d, point, cov = splat(g["means"][k], g["covs"][k], pose, camera, scale, float(config.blur))
        normal, reach = pose[:3, :3].T @ g["normals"][k], radius * np.sqrt(cov[2, 2])
        precision = np.linalg.inv(cov_2d)
        offset = pixels - pixel
        distance_sq = np.einsum("yxi,ij,yxj->yx", offset, precision, offset)
        weight = np.where(distance_sq > radius**2, 0.0, light * float(config.opacity) * np.exp(-0.5 * distance_sq))
        z = plane_depth(pixels, point, normal, reach, camera)
        image += weight[..., None] * values[k]
        depth += weight * z
        depth_sq += weight * z**2
        alpha += weight
        light -= weight
    is_covered, total = alpha >= config.min_alpha, np.maximum(alpha, 1e-9)
    mean = np.where(is_covered, depth / total, 0.0)
    return image, alpha, mean, np.sqrt(np.where(is_covered, np.maximum(depth_sq / total - mean**2, 0), 0.0))


def refine(g, weight, candidates, pose, camera, config):
    """Eq. 5 and 6: {row: (mean, cov, normal, colour, weight)} of the map Gaussians that change, and who is fresh."""
    scale, blur, radius = (float(x) for x in (config.render.covariance_scale, config.render.blur, config.render.radius))
    _, _, depth, _ = render(g, g["colors"], pose, camera, config.render)

    def seen(h):
        found = {}
        for k in np.flatnonzero(h["valid"]):
            if is_drawn(h["means"][k], h["covs"][k], h["normals"][k], pose, scale):
                pixel, cov_2d, point, cov = splat(h["means"][k], h["covs"][k], pose, camera, scale, blur)
                column, row = np.round(pixel).astype(int)
                is_inside = 0 <= column < camera.width and 0 <= row < camera.height
                found[k] = pixel, cov_2d, point, np.sqrt(cov[2, 2]), depth[row, column] if is_inside else 0.0
        return found

    known = seen(g)
    visible = [k for k, (*_, point, std, d) in known.items() if d > 0 and point[2] <= d + radius * std]
    shares, is_fresh = {}, np.array(candidates["valid"])
    is_within = lambda z, d: -config.front_margin <= z / d - 1 <= config.back_margin  # noqa: E731

    def agree(j, k, pixel, z):
        """One surface: alike normals, and with `pairs` the candidate near the plane of the map's Gaussian."""
        _, _, point, std, _ = known[k]
        plane = plane_depth(pixel, point, pose[:3, :3].T @ g["normals"][k], radius * std, camera)
        is_alike = g["normals"][k] @ candidates["normals"][j] >= config.min_normal_cos
        return is_alike and (config.depth_condition == 0 or is_within(z, plane))

    for j, (pixel, cov_2d, (*_, z), _, d) in seen(candidates).items():
        if d == 0 or not is_within(z, d):
            continue
        nearest = sorted(visible, key=lambda k, at=pixel: np.linalg.norm(known[k][0] - at))[: config.num_candidates]
        nearest = [k for k in nearest if agree(j, k, pixel, z)]
        offsets = [known[k][0] - pixel for k in nearest]
        distances_sq = [o @ np.linalg.inv(known[k][1] + cov_2d) @ o for k, o in zip(nearest, offsets, strict=True)]
        exponent = np.exp(-0.5 * np.array(distances_sq))
        for k, distance_sq, omega in zip(nearest, distances_sq, exponent / exponent.sum(), strict=True):
            features = g["features"][k], candidates["features"][j]
            told = float(config.cosine_weight) * (max(np.dot(*features), 0.0) - 1.0)
            omega *= 1.0 + told if all(f.any() for f in features) else 1.0
            if distance_sq < config.max_mahalanobis_sq_2d and omega > 0:
                shares.setdefault(k, []).append((j, omega))
                is_fresh[j] = False
    changed = {}
    for k, merging in shares.items():
        rows, omega = [j for j, _ in merging], np.array([omega for _, omega in merging])
        share, x = omega / omega.sum(), candidates["means"][[j for j, _ in merging]]
        mean = share @ x
        cov = np.einsum("i,iab->ab", share, candidates["covs"][rows]) + (share[:, None] * (x - mean)).T @ (x - mean)
        normal = share @ candidates["normals"][rows]
        new = mean, cov, normal / np.linalg.norm(normal), share @ candidates["colors"][rows]
        gain, kept = gain_and_weight(weight[k], omega.max(), config.average)  # eq. 6: the best of them, not their sum
        changed[k] = (*moved(g, k, new, gain), kept)
    return changed, is_fresh


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

"""Objects in a map: clusters of the Gaussians that answer to a word."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from emgs_jax.ops.ranges import number


@dataclass(frozen=True)
class InstanceConfig:
    """Clustering of a query's answers into objects by DBSCAN."""

    reach: float = number(3.0, low=1e-6, high=1e6)  # in median distances between nearest Gaussians of the map
    min_gaussians: int = number(3, low=1, high=10**6)  # DBSCAN's minPts: within `reach` of one, itself included


@dataclass(frozen=True)
class Instance:
    """One object, in the frame and unit of the map."""

    center: np.ndarray
    low: np.ndarray  # of its Gaussians' bounding box along the map's axes, one standard deviation around the means
    high: np.ndarray
    score: float
    lead: float
    rows: np.ndarray


def reach_of(means: np.ndarray, config: InstanceConfig) -> float:
    """DBSCAN's ε in the unit of means (n, 3); 0 for fewer than two."""
    if len(means) < 2:
        return 0.0
    return config.reach * float(np.median(cKDTree(means).query(means, k=2)[0][:, 1]))


def clusters(points: np.ndarray, reach: float, min_points: int) -> np.ndarray:
    """The cluster of each point (n, 3) by DBSCAN, from 0; -1 for noise."""
    if not len(points) or reach <= 0:
        return np.full(len(points), -1)
    import open3d as o3d  # slow to import

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points, np.float64)))
    return np.asarray(cloud.cluster_dbscan(reach, min_points), np.int64)


def find_instances(
    answers: np.ndarray,
    shape: tuple[np.ndarray, np.ndarray],
    strength: tuple[np.ndarray, np.ndarray],
    reach: float,
    min_gaussians: int,
) -> list[Instance]:
    """Cluster the Gaussians that answer to a word (rows `answers`), the largest sum of cosines first.

    Of all Gaussians, `shape` has means (n, 3) and covariances (n, 3, 3), `strength` cosines and leads (n,).
    """
    means, covs = (np.asarray(values, np.float64) for values in shape)
    cosines, leads = (np.asarray(values, np.float64) for values in strength)
    numbers = clusters(means[answers], reach, min_gaussians)
    found = []
    for one in range(numbers.max(initial=-1) + 1):
        rows = answers[numbers == one]
        spread = np.sqrt(np.diagonal(covs[rows], axis1=1, axis2=2))
        low, high = (means[rows] - spread).min(0), (means[rows] + spread).max(0)
        score, lead = float(cosines[rows].mean()), float(leads[rows].mean())
        found.append(Instance(means[rows].mean(0), low, high, score, lead, rows))
    return sorted(found, key=lambda one: -one.score * len(one.rows))

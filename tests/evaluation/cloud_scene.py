"""Random clouds, and depth images of planes, for the tests of clouds, normals and reconstructions."""

import numpy as np

from emgs_jax.data.backprojection import backproject
from emgs_jax.evaluation.clouds import PointCloud

INTRINSICS = (110.0, 95.0, 61.0, 47.0)  # fx ≠ fy, centre not in the middle
SHAPE = (90, 120)


def plane_depth(normal, distance):
    """Depth image of the plane normal · p = distance."""
    return distance / (backproject(np.ones(SHAPE), INTRINSICS) @ np.asarray(normal))


def random_cloud(rng, n=400):
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(rng.uniform(-1, 1, (n, 3)), normals, rng.uniform(size=(n, 3)))

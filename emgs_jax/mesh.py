"""A surface through oriented points: Poisson reconstruction without what it invents."""

import numpy as np
from scipy.spatial import cKDTree


def crop(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Leave out far flying points: the solver's grid spans all points, so they would make the cells coarse."""
    low, high = np.percentile(points, [1, 99], axis=0)
    margin = 0.25 * np.max(high - low)
    keep = ((points >= low - margin) & (points <= high + margin)).all(1)
    return points[keep], normals[keep]


def poisson(points: np.ndarray, normals: np.ndarray, depth: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) and triangles (t, 3) of the surface through points with normals, both (n, 3)."""
    import open3d as o3d  # slow to import, and only a mesh needs it

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
            cloud, depth=depth, linear_fit=True, n_threads=1
        )  # more threads would add in another order each time
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles)


def trim(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drop the surface that Poisson invents: what is farther from all points than their own spacing explains."""
    spacing = np.median(cKDTree(points).query(points, k=7)[0][:, -1])
    near = cKDTree(points).query(vertices)[0] <= 2.0 * spacing if len(vertices) else np.empty(0, bool)
    faces = faces[near[faces].all(1)] if len(faces) else faces
    used = np.unique(faces)
    return vertices[used], np.searchsorted(used, faces)

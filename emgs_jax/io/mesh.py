"""Mesh oriented points by Poisson reconstruction, without the surface that it invents."""

import os
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from emgs_jax.io.ply import structured, with_colors, write_ply


def save_mesh_ply(
    path: str | os.PathLike, points: Any, normals: Any, colored: tuple[Any, Any], depth: int = 8, min_points: int = 50
) -> str | None:
    """Mesh points (n, 3) with unit normals (n, 3) and write the mesh as PLY; deterministic.

    Args:
        colored: points (m, 3) and their RGB in [0, 1], (m, 3): a vertex takes the colour of the nearest.

    Returns:
        None, or why there is no mesh; then an older file is removed.
    """
    points, normals = (np.asarray(value, np.float64) for value in (points, normals))
    keep = np.isfinite(points).all(1) & np.isfinite(normals).all(1) & (np.linalg.norm(normals, axis=1) > 0.5)
    points, normals = points[keep], normals[keep]
    if len(points) < min_points:
        Path(path).unlink(missing_ok=True)
        return f"{len(points)} points with a normal, at least {min_points} are needed for a mesh"
    vertices, faces = trim(*poisson(*crop(points, normals), depth), cKDTree(points))
    if not len(faces):
        Path(path).unlink(missing_ok=True)
        return "the surface reconstruction is empty"
    colors = np.asarray(colored[1])[cKDTree(colored[0]).query(vertices)[1]]
    write_ply(path, with_colors(structured(vertices.astype(np.float32), ["x", "y", "z"]), colors), faces)
    return None


def crop(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Leave out far outliers: the solver's grid spans all points, so its cells would be coarse."""
    low, high = np.percentile(points, [1, 99], axis=0)
    margin = 0.25 * np.max(high - low)
    keep = ((points >= low - margin) & (points <= high + margin)).all(1)
    return points[keep], normals[keep]


def poisson(points: np.ndarray, normals: np.ndarray, depth: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) and triangles (t, 3) of the surface through points with normals, both (n, 3)."""
    import open3d as o3d  # slow to import

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
            cloud, depth=depth, linear_fit=True, n_threads=1
        )  # more threads would add in another order each time
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles)


def trim(vertices: np.ndarray, faces: np.ndarray, tree: cKDTree) -> tuple[np.ndarray, np.ndarray]:
    """Drop the surface that is farther from all points than their spacing explains."""
    spacing = np.median(tree.query(tree.data, k=7)[0][:, -1])
    near = tree.query(vertices)[0] <= 2.0 * spacing if len(vertices) else np.empty(0, bool)
    faces = faces[near[faces].all(1)] if len(faces) else faces
    used = np.unique(faces)
    return vertices[used], np.searchsorted(used, faces)

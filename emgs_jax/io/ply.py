"""Write PLY: clouds, meshes, and Gaussians for viewers of 3D Gaussian splatting."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.io.files import atomic_write

_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}
SH_C0 = 0.28209479177387814  # constant of the zeroth spherical harmonic, as 3DGS viewers use it


def save_gaussians_ply(
    path: str | os.PathLike,
    means: Any,
    covs: Any,
    colors: Any,
    opacity: Any,
    normals: Any = None,
    labels: Any = None,
    classes: Sequence[str] = (),
) -> int:
    """Write Gaussians in the layout of 3D Gaussian splatting, without rows that are not finite; return their number.

    Args:
        means: (n, 3).
        covs: (n, 3, 3), written as log standard deviations and a quaternion w, x, y, z.
        colors: (n, 3), RGB in [0, 1], written as the zeroth spherical harmonic.
        opacity: a number or (n,), in (0, 1), written as its logit.
        normals: (n, 3); None: zero.
        labels, classes: see `write_ply`.
    """
    means, covs, colors = (np.asarray(value, np.float64) for value in (means, covs, colors))
    normals = np.zeros_like(means) if normals is None else np.asarray(normals, np.float64)
    opacity = np.broadcast_to(np.asarray(opacity, np.float64), len(means)).clip(1e-6, 1 - 1e-6)
    flat = np.concatenate([means, normals, (colors - 0.5) / SH_C0, np.log(opacity / (1 - opacity))[:, None]], 1)
    keep = np.isfinite(flat).all(1) & np.isfinite(covs).all((1, 2))
    variances, axes = np.linalg.eigh(covs[keep])
    axes *= np.sign(np.linalg.det(axes))[:, None, None]  # a rotation, not a reflection
    scales = 0.5 * np.log(np.maximum(variances, 1e-14))
    quaternions = Rotation.from_matrix(axes).as_quat(canonical=True)[:, [3, 0, 1, 2]] if len(axes) else np.empty((0, 4))
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), "opacity"]
    names += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    rows = np.concatenate([flat[keep], scales, quaternions], 1).astype(np.float32)
    write_ply(path, structured(rows, names), None, None if labels is None else np.asarray(labels)[keep], classes)
    return len(rows)


def save_points_ply(
    path: str | os.PathLike, points: Any, normals: Any, colors: Any, labels: Any = None, classes: Sequence[str] = ()
) -> int:
    """Write the finite rows of points, normals and RGB in [0, 1], each (n, 3); return their number."""
    rows = np.concatenate([np.asarray(points), np.asarray(normals)], 1).astype(np.float32)
    keep = np.isfinite(rows).all(1)
    vertices = with_colors(structured(rows[keep], ["x", "y", "z", "nx", "ny", "nz"]), np.asarray(colors)[keep])
    write_ply(path, vertices, None, None if labels is None else np.asarray(labels)[keep], classes)
    return len(vertices)


def write_ply(
    path: str | os.PathLike,
    vertices: np.ndarray,
    faces: np.ndarray | None = None,
    labels: np.ndarray | None = None,
    classes: Sequence[str] = (),
) -> None:
    """Write a binary little-endian PLY.

    Args:
        vertices: structured array (n,); its fields become the properties.
        faces: vertex indices (t, 3); None for a cloud.
        labels: (n,), -1 = none; None for no property `label`.
        classes: names of the labels, for the header's comments.
    """
    if labels is not None:
        vertices = with_fields(vertices, {"label": labels.astype("i4")})
    vertices = vertices.astype(vertices.dtype.newbyteorder("<"))
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment label {number} {name}" for number, name in enumerate(classes)]
    header.append(f"element vertex {len(vertices)}")
    for name in vertices.dtype.names:
        header.append(f"property {_PLY_TYPES[vertices.dtype[name].str[1:]]} {name}")
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    with atomic_write(path) as handle:
        handle.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii", "replace"))
        handle.write(vertices.tobytes())
        if faces is not None:
            rows = np.empty(len(faces), [("count", "u1"), ("indices", "<i4", (3,))])
            rows["count"], rows["indices"] = 3, faces
            handle.write(rows.tobytes())


def structured(rows: np.ndarray, names: list[str]) -> np.ndarray:
    """View rows (n, c) as a structured array (n,) with one field per column."""
    return np.ascontiguousarray(rows).view([(name, rows.dtype) for name in names])[:, 0]


def with_colors(rows: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Add the 8-bit fields red, green and blue, from RGB (n, 3) in [0, 1]."""
    channels = np.rint(255.0 * np.nan_to_num(colors).clip(0.0, 1.0)).astype(np.uint8)
    return with_fields(rows, dict(zip(("red", "green", "blue"), channels.T, strict=True)))


def with_fields(rows: np.ndarray, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Add fields to a structured array; `recfunctions.append_fields` takes a second for 100,000 rows."""
    types = [(name, rows.dtype[name]) for name in rows.dtype.names]
    found = np.empty(len(rows), types + [(name, column.dtype) for name, column in columns.items()])
    for name in rows.dtype.names:
        found[name] = rows[name]
    for name, column in columns.items():
        found[name] = column
    return found

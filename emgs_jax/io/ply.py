"""PLY: clouds, triangles, and Gaussians as viewers of 3D Gaussian splatting read them."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.lib import recfunctions
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
    """Write Gaussians as 3D Gaussian splatting viewers read them; returns how many, rows that are not finite left out.

    Args:
        means: (n, 3), metres, world.
        covs: (n, 3, 3), square metres; written as log standard deviations and a quaternion (w, x, y, z).
        colors: (n, 3), RGB in [0, 1]; written as the zeroth spherical harmonic.
        opacity: a number or (n,), in (0, 1); written as its logit.
        normals: (n, 3) or None for zeros.
        labels: (n,) or None for no property `label`; as of `save_points_ply`.
        classes: their names.
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
    vertices = structured(rows, names)
    if labels is not None:
        vertices = _with_labels(vertices, np.asarray(labels)[keep])
    write_ply(path, vertices, comments=_class_lines(classes))
    return len(rows)


def save_points_ply(
    path: str | os.PathLike, points: Any, normals: Any, colors: Any, labels: Any = None, classes: Sequence[str] = ()
) -> int:
    """Write a cloud: points (n, 3) in metres, normals (n, 3), colours (n, 3) RGB in [0, 1]. Returns how many rows.

    Labels (n,) become the property `label`, -1 = none; comments of the header say which class each number is.
    """
    rows = np.concatenate([np.asarray(points), np.asarray(normals)], 1).astype(np.float32)
    keep = np.isfinite(rows).all(1)
    vertices = with_colors(structured(rows[keep], ["x", "y", "z", "nx", "ny", "nz"]), np.asarray(colors)[keep])
    if labels is not None:
        vertices = _with_labels(vertices, np.asarray(labels)[keep])
    write_ply(path, vertices, comments=_class_lines(classes))
    return int(keep.sum())


def _with_labels(vertices: np.ndarray, labels: np.ndarray) -> np.ndarray:
    return recfunctions.append_fields(vertices, "label", labels.astype("i4"), usemask=False)


def _class_lines(classes: Sequence[str]) -> list[str]:
    return [f"label {number} {name}".encode("ascii", "replace").decode() for number, name in enumerate(classes)]


def write_ply(
    path: str | os.PathLike, vertices: np.ndarray, faces: np.ndarray | None = None, comments: Sequence[str] = ()
) -> None:
    """Write a binary little-endian PLY.

    Args:
        vertices: structured array (n,); its field names become the properties, in order.
        faces: triangles as vertex indices, int (t, 3); None for a cloud.
        comments: lines of the header, ASCII.
    """
    vertices = vertices.astype(vertices.dtype.newbyteorder("<"))
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header.append(f"element vertex {len(vertices)}")
    for name in vertices.dtype.names:
        header.append(f"property {_PLY_TYPES[vertices.dtype[name].str[1:]]} {name}")
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    with atomic_write(path) as handle:
        handle.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        handle.write(vertices.tobytes())
        if faces is not None:
            rows = np.empty(len(faces), [("count", "u1"), ("indices", "<i4", (3,))])
            rows["count"], rows["indices"] = 3, faces
            handle.write(rows.tobytes())


def structured(rows: np.ndarray, names: list[str]) -> np.ndarray:
    """Rows (n, c) of one type as a structured array (n,) with one field per column."""
    return np.ascontiguousarray(rows).view([(name, rows.dtype) for name in names])[:, 0]


def with_colors(rows: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """A structured array with the fields red, green and blue, 8 bits each, of RGB (n, 3) in [0, 1]."""
    out = np.empty(len(rows), rows.dtype.descr + [(name, "u1") for name in ("red", "green", "blue")])
    for name in rows.dtype.names:
        out[name] = rows[name]
    channels = np.rint(255.0 * np.nan_to_num(colors).clip(0.0, 1.0)).astype(np.uint8)
    out["red"], out["green"], out["blue"] = channels.T
    return out

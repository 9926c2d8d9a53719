"""Write what a run leaves behind: map, Gaussians, points, mesh and trajectory. Every write is atomic."""

import dataclasses
import io
import json
import os
import typing
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.lib import recfunctions
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from emgs_jax.files import atomic_write, write_ply
from emgs_jax.mesh import crop, poisson, trim

MAP_FORMAT, MAP_VERSION = "emgs_jax.map", 1
_SH_C0 = 0.28209479177387814  # constant of the zeroth spherical harmonic, as 3DGS viewers use it


def save_map_npz(path: str | os.PathLike, tree: eqx.Module) -> None:
    """Write a module of arrays: each leaf under its field path, and a header with version, class and static fields."""
    leaves = {_name(key): leaf for key, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]}
    for name, leaf in leaves.items():
        if not eqx.is_array(leaf) or np.asarray(leaf).dtype.kind not in "biufc":
            raise ValueError(f"map leaf {name!r} is {type(leaf).__name__}, not a plain array: it would not reload")
    header = {"format": MAP_FORMAT, "version": MAP_VERSION, "class": type(tree).__name__}
    header |= {"leaves": sorted(leaves), "static": _static_fields(tree)}
    with atomic_write(path) as handle:
        np.savez(handle, __header__=np.array(json.dumps(header)), **{k: np.asarray(v) for k, v in leaves.items()})


def load_map_npz(path: str | os.PathLike, like: Any) -> Any:
    """Read a map back, bit for bit.

    Args:
        like: the class that was saved (an eqx.Module whose fields are arrays, modules or static), or an instance of
            it; the shapes are those of the file.

    Raises ValueError for every file that is not a complete map of this class and version.
    """
    try:
        arrays = _read_arrays(path)
        header = json.loads(str(arrays.pop("__header__", "{}")))
        header = header if isinstance(header, dict) else {}
    except FileNotFoundError:
        raise
    except Exception as error:  # a broken zip raises a dozen types
        raise ValueError(f"{path} is not a readable map ({error}): it is truncated or damaged, map again") from error
    cls = like if isinstance(like, type) else type(like)
    if header.get("format") != MAP_FORMAT:
        raise ValueError(f"{path} is not a map of emgs_jax: give the map.npz of a run")
    if header.get("version") != MAP_VERSION:
        raise ValueError(f"{path} has map version {header.get('version')}, this code reads {MAP_VERSION}: map again")
    if header.get("class") != cls.__name__ or header.get("leaves") != sorted(arrays):
        raise ValueError(
            f"{path} holds a {header.get('class')}, expected {cls.__name__} with all its arrays: map again"
        )
    try:
        tree = _build(cls, "", arrays, header["static"])
    except Exception as error:
        raise ValueError(f"{path} does not fit {cls.__name__} ({error!r}): written by other code, map again") from error
    if arrays:
        raise ValueError(f"{path} has arrays that {cls.__name__} does not know: {sorted(arrays)}; map again")
    return tree


def save_gaussians_ply(
    path: str | os.PathLike, means: Any, covs: Any, colors: Any, opacity: Any, normals: Any = None
) -> int:
    """Write Gaussians as 3D Gaussian splatting viewers read them; returns how many, rows that are not finite left out.

    Args:
        means: (n, 3), metres, world.
        covs: (n, 3, 3), square metres; written as log standard deviations and a quaternion (w, x, y, z).
        colors: (n, 3), RGB in [0, 1]; written as the zeroth spherical harmonic.
        opacity: a number or (n,), in (0, 1); written as its logit.
        normals: (n, 3) or None for zeros.
    """
    means, covs, colors = (np.asarray(value, np.float64) for value in (means, covs, colors))
    normals = np.zeros_like(means) if normals is None else np.asarray(normals, np.float64)
    opacity = np.broadcast_to(np.asarray(opacity, np.float64), len(means)).clip(1e-6, 1 - 1e-6)
    flat = np.concatenate([means, normals, (colors - 0.5) / _SH_C0, np.log(opacity / (1 - opacity))[:, None]], 1)
    keep = np.isfinite(flat).all(1) & np.isfinite(covs).all((1, 2))
    variances, axes = np.linalg.eigh(covs[keep])
    axes *= np.sign(np.linalg.det(axes))[:, None, None]  # a rotation, not a reflection
    scales = 0.5 * np.log(np.maximum(variances, 1e-14))
    quaternions = Rotation.from_matrix(axes).as_quat(canonical=True)[:, [3, 0, 1, 2]] if len(axes) else np.empty((0, 4))
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), "opacity"]
    names += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    rows = np.concatenate([flat[keep], scales, quaternions], 1).astype(np.float32)
    write_ply(path, _structured(rows, names))
    return len(rows)


def save_points_ply(
    path: str | os.PathLike, points: Any, normals: Any, colors: Any, labels: Any = None, classes: Sequence[str] = ()
) -> int:
    """Write a cloud: points (n, 3) in metres, normals (n, 3), colours (n, 3) RGB in [0, 1]. Returns how many rows.

    Labels (n,) become the property `label`, -1 = none; comments of the header say which class each number is.
    """
    rows = np.concatenate([np.asarray(points), np.asarray(normals)], 1).astype(np.float32)
    keep = np.isfinite(rows).all(1)
    vertices = _with_colors(_structured(rows[keep], ["x", "y", "z", "nx", "ny", "nz"]), np.asarray(colors)[keep])
    if labels is not None:
        numbers = np.asarray(labels)[keep].astype("i4")
        vertices = recfunctions.append_fields(vertices, "label", numbers, usemask=False)
    names = [f"label {number} {name}".encode("ascii", "replace").decode() for number, name in enumerate(classes)]
    write_ply(path, vertices, comments=names)
    return int(keep.sum())


def save_mesh_ply(
    path: str | os.PathLike, points: Any, normals: Any, colors: Any, depth: int = 8, min_points: int = 50
) -> str | None:
    """Mesh oriented points (Poisson, trimmed where points are far) and write it; deterministic.

    Returns None, or the reason why there is no mesh; then no file is written and an older one is removed.
    """
    points, normals, colors = (np.asarray(value, np.float64) for value in (points, normals, colors))
    keep = np.isfinite(points).all(1) & np.isfinite(normals).all(1) & (np.linalg.norm(normals, axis=1) > 0.5)
    points, normals, colors = points[keep], normals[keep], colors[keep]
    reason = None
    if len(points) < min_points:
        reason = f"{len(points)} points with a normal, at least {min_points} are needed for a mesh"
    else:
        vertices, faces = poisson(*crop(points, normals), depth)
        vertices, faces = trim(vertices, faces, points)
        reason = None if len(faces) else "the surface reconstruction is empty"
    if reason is not None:
        Path(path).unlink(missing_ok=True)
        return reason
    nearest = cKDTree(points).query(vertices)[1]
    write_ply(path, _with_colors(_structured(vertices.astype(np.float32), ["x", "y", "z"]), colors[nearest]), faces)
    return None


def save_trajectory_tum(path: str | os.PathLike, timestamps: Any, T_world_camera: Any) -> None:
    """Write poses (n, 4, 4) as lines `timestamp tx ty tz qx qy qz qw`, metres, camera → world, qw ≥ 0."""
    poses, timestamps = np.asarray(T_world_camera, np.float64), np.asarray(timestamps, np.float64)
    if poses.shape != (len(timestamps), 4, 4) or not np.isfinite(poses).all():
        raise ValueError(f"T_world_camera must be finite ({len(timestamps)}, 4, 4), got {poses.shape}")
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for time, pose in zip(timestamps, poses, strict=True):
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
        lines.append(" ".join([f"{time:.6f}", *(f"{value:.9f}" for value in (*pose[:3, 3], *quaternion))]))
    with atomic_write(path, "w") as handle:
        handle.write("\n".join(lines) + "\n")


def load_trajectory_tum(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray]:
    """Read a TUM trajectory: timestamps (n,) and T_world_camera (n, 4, 4), float64; `#` starts a comment."""
    rows = []
    for number, line in enumerate(Path(path).read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        fields = line.split("#")[0].split()
        try:
            values = [float(field) for field in fields]
        except ValueError:
            values = [np.nan]
        if fields and (len(values) != 8 or not np.isfinite(values).all() or not np.any(values[4:])):
            raise ValueError(f"{path}:{number}: expected `timestamp tx ty tz qx qy qz qw`, got {line[:80]!r}")
        if fields:
            rows.append(values)
    rows = np.array(rows, np.float64).reshape(-1, 8)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3] = rows[:, 1:4]
    if len(rows):
        poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    return rows[:, 0], poses


def _structured(rows: np.ndarray, names: list[str]) -> np.ndarray:
    return np.ascontiguousarray(rows).view([(name, rows.dtype) for name in names])[:, 0]


def _with_colors(rows: np.ndarray, colors: np.ndarray) -> np.ndarray:
    out = np.empty(len(rows), rows.dtype.descr + [(name, "u1") for name in ("red", "green", "blue")])
    for name in rows.dtype.names:
        out[name] = rows[name]
    channels = np.rint(255.0 * np.nan_to_num(colors).clip(0.0, 1.0)).astype(np.uint8)
    out["red"], out["green"], out["blue"] = channels.T
    return out


def _name(key_path: tuple) -> str:
    return jax.tree_util.keystr(key_path, simple=True, separator=".")


def _read_arrays(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Read every member completely before it is parsed, so that its checksum is tested first."""
    arrays = {}
    with zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            member = io.BytesIO(archive.read(name))
            arrays[name.removesuffix(".npy")] = np.lib.format.read_array(member, allow_pickle=False)
    return arrays


def _static_fields(tree: eqx.Module, prefix: str = "") -> dict[str, Any]:
    """Values of static fields by path; they must be what JSON has."""
    values = {}
    for field in dataclasses.fields(tree):
        value = getattr(tree, field.name)
        if field.metadata.get("static", False):
            values[prefix + field.name] = value
        elif isinstance(value, eqx.Module):
            values |= _static_fields(value, f"{prefix}{field.name}.")
    return values


def _build(cls: type, prefix: str, arrays: dict[str, np.ndarray], static: dict[str, Any]) -> Any:
    """Make an instance of `cls` from the arrays of its fields, which are taken out of `arrays`."""
    hints = typing.get_type_hints(cls)
    fields = {}
    for field in dataclasses.fields(cls):
        name, hint = prefix + field.name, hints[field.name]
        if field.metadata.get("static", False):
            fields[field.name] = static[name]
        elif isinstance(hint, type) and issubclass(hint, eqx.Module):
            fields[field.name] = _build(hint, f"{name}.", arrays, static)
        else:
            fields[field.name] = jnp.asarray(arrays.pop(name))
    return cls(**fields)

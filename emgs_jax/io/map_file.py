"""The map's file: every leaf under its field path, bit for bit, and a header that says what it is."""

import dataclasses
import json
import os
import typing
from typing import Any

import equinox as eqx
import jax
import numpy as np

from emgs_jax.gaussian_map import GaussianMap, empty_map
from emgs_jax.io.files import atomic_write
from emgs_jax.io.npz import read_npz
from emgs_jax.ops.ranges import MAX_LENGTH_M

MAP_FORMAT, MAP_VERSION = "emgs_jax.map", 3


def save_map(path: str | os.PathLike, map: GaussianMap) -> None:
    """Write a map as .npz; `load_map` reads the same bits."""
    save_map_npz(path, map)


def load_map(path: str | os.PathLike) -> GaussianMap:
    """Read the map.npz of a run; raises ValueError for a file that is no complete, finite map of this version."""
    map = load_map_npz(path, GaussianMap)
    check_map(path, map)
    return map


def check_map(path: str | os.PathLike, map: GaussianMap) -> None:
    """Raise ValueError where a leaf has not a map's dtype and shape, or is not finite where there is a Gaussian."""
    map = jax.device_get(map)
    valid, features = map.gaussians.valid, map.gaussians.features
    if valid.ndim != 1 or valid.dtype != bool or features.ndim != 2:
        raise ValueError(f"{path} is no map: gaussians.valid is {valid.dtype} {valid.shape}: map again")
    shapes = jax.eval_shape(lambda: empty_map(len(valid), features.shape[1]))
    leaves, expected = (jax.tree_util.tree_flatten_with_path(tree)[0] for tree in (map, shapes))
    for (key, leaf), (_, like) in zip(leaves, expected, strict=True):
        if (leaf.shape, leaf.dtype) != (like.shape, like.dtype):
            wanted = f"{like.dtype} {like.shape}"
            raise ValueError(f"{path}: {_name(key)} is {leaf.dtype} {leaf.shape}, expected {wanted}: map again")
        if not np.isfinite(leaf[valid]).all():
            raise ValueError(f"{path}: {_name(key)} is not finite where there is a Gaussian: map again")
    covs, means = np.asarray(map.gaussians.covs[valid], np.float64), np.asarray(map.gaussians.means[valid])
    if np.abs(means).max(initial=0.0) > MAX_LENGTH_M or np.abs(covs).max(initial=0.0) > MAX_LENGTH_M**2:
        raise ValueError(f"{path} has a Gaussian {MAX_LENGTH_M:g} m away or large: it is damaged, map again")
    is_symmetric = np.abs(covs - covs.mT) <= 1e-4 * np.trace(covs, axis1=1, axis2=2)[:, None, None]
    if not is_symmetric.all() or not (np.linalg.eigvalsh(covs) > 0).all():
        raise ValueError(f"{path}: gaussians.covs has one that is no covariance: map again")


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
        with open(path, "rb") as handle:
            arrays = read_npz(handle)
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


def _name(key_path: tuple) -> str:
    return jax.tree_util.keystr(key_path, simple=True, separator=".")


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
            given = arrays.pop(name)
            fields[field.name] = jax.device_put(given)
            if fields[field.name].dtype != given.dtype:
                raise ValueError(f"{name} is {given.dtype}, which this code does not write")
    return cls(**fields)

"""map.npz: every array of a map under its field path, bit for bit, and a header."""

import os

import jax
import numpy as np

from emgs_jax.gaussian_map import GaussianMap, empty_map
from emgs_jax.io.npz import load_headed, save_headed
from emgs_jax.ops.ranges import MAX_LENGTH_M

MAP_FORMAT, MAP_VERSION, CLASS = "emgs_jax.map", 3, GaussianMap.__name__


def save_map(path: str | os.PathLike, map: GaussianMap) -> None:
    """Write a map as .npz, which `load_map` reads back bit for bit."""
    arrays = {_name(key): np.asarray(leaf) for key, leaf in jax.tree_util.tree_flatten_with_path(map)[0]}
    header = {"format": MAP_FORMAT, "version": MAP_VERSION, "class": CLASS, "leaves": sorted(arrays), "static": {}}
    save_headed(path, header, arrays)


def load_map(path: str | os.PathLike) -> GaussianMap:
    """Read the map.npz of a run; ValueError unless it is a complete, finite map of this version."""
    try:
        _, arrays = load_headed(path, {"format": MAP_FORMAT, "version": MAP_VERSION, "class": CLASS})
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} is no map.npz of a run that can be read ({error}): map again") from error
    fields, structure = jax.tree_util.tree_flatten_with_path(jax.eval_shape(lambda: empty_map(1, 1)))
    names = [_name(key) for key, _ in fields]
    if "weight" in arrays:  # maps of older versions have no views that saw through a Gaussian
        arrays.setdefault("num_through", np.zeros(arrays["weight"].shape, np.float32))
    if sorted(arrays) != sorted(names):
        raise ValueError(f"{path} holds other arrays than those of a {CLASS}: map again")
    map = jax.tree.unflatten(structure, [arrays[name] for name in names])
    check_map(path, map)  # before JAX, which would cast what is of another type
    return jax.device_put(map)


def check_map(path: str | os.PathLike, map: GaussianMap) -> None:
    """Raise ValueError if an array has the wrong dtype or shape, or holds impossible values of a Gaussian."""
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


def _name(key_path: tuple) -> str:
    return jax.tree_util.keystr(key_path, simple=True, separator=".")

"""Oracles: bit-for-bit reloading, and every damage is noticed."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emgs_jax.gaussian_map import empty_map
from emgs_jax.io.map_file import check_map, load_map, save_map


def a_map(num_features=2):
    """Three Gaussians in a map with room for five, whose free rows hold anything, and zeros of both signs."""
    map = eqx.tree_at(lambda m: m.gaussians.valid, empty_map(5, num_features), jnp.arange(5) < 3)
    map = eqx.tree_at(lambda m: m.gaussians.means, map, map.gaussians.means.at[4].set(jnp.nan))
    return eqx.tree_at(lambda m: m.weight, map, jnp.full(5, -0.0))


def assert_same(a, b):
    assert jax.tree_util.tree_structure(a) == jax.tree_util.tree_structure(b)
    for x, y in zip(jax.tree_util.tree_leaves(a), jax.tree_util.tree_leaves(b), strict=True):
        assert (x.dtype, x.shape) == (y.dtype, y.shape)
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


@pytest.mark.parametrize("width", [0, 2])
def test_a_map_reloads_bit_for_bit(tmp_path, width):
    map = a_map(width)
    save_map(tmp_path / "map.npz", map)
    assert_same(load_map(tmp_path / "map.npz"), map)
    save_map(tmp_path / "again.npz", map)
    assert (tmp_path / "map.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()
    with np.load(tmp_path / "map.npz", allow_pickle=False) as arrays:
        assert set(arrays) == {
            *("weight", "num_updates", "existence", "birth", "num_through", "__header__"),
            *(f"gaussians.{name}" for name in ("means", "covs", "colors", "normals", "features", "valid")),
        }


def test_a_map_of_a_version_without_looks_through_is_read_as_if_none_had_been(tmp_path):
    path, map = tmp_path / "map.npz", a_map()
    save_map(path, map)
    with np.load(path) as file:
        arrays = {name: array for name, array in file.items() if name != "num_through"}
    np.savez(path, **arrays)
    assert_same(load_map(path), map)


def test_truncated_or_flipped_maps_raise_value_error_or_hold_the_same(tmp_path):
    path = tmp_path / "map.npz"
    map = a_map()
    save_map(path, map)
    whole = path.read_bytes()
    rng = np.random.default_rng(1)
    damaged = [whole[:length] for length in (0, 1, 30, len(whole) // 2, len(whole) - 1)]
    for position in np.linspace(0, len(whole) - 1, 500).astype(int):
        flipped = bytearray(whole)
        flipped[position] ^= 1 << rng.integers(8)
        damaged.append(bytes(flipped))
    rejected = 0
    for content in damaged:
        path.write_bytes(content)
        try:
            assert_same(load_map(path), map)
        except ValueError as error:
            rejected += 1
            assert "map.npz" in str(error)
    assert rejected > 250


def test_foreign_and_newer_maps_are_named_with_the_remedy(tmp_path):
    path = tmp_path / "map.npz"
    save_map(path, a_map())
    with np.load(path) as file:
        arrays = dict(file)
    header = json.loads(str(arrays["__header__"]))
    for content, message in (
        ({"weight": np.ones(3)}, "it has no header"),
        ({"__header__": np.array("[]")}, "format is None, this code reads 'emgs_jax.map'"),
        ({"__header__": np.array(json.dumps(header | {"version": 99}))}, "version is 99, this code reads 3"),
        ({"__header__": np.array(json.dumps(header | {"class": "Other"}))}, "class is 'Other', this code reads 'Gau"),
        ({"__header__": np.array([{}], dtype=object)}, "no map.npz of a run that can be read"),
        ({"__header__": arrays["__header__"], "weight": np.ones(3)}, "other arrays than those of a GaussianMap"),
        (arrays | {"more": np.ones(3)}, "other arrays than those of a GaussianMap"),
        (arrays | {"weight": arrays["weight"].astype(np.float64)}, "weight is float64"),  # doubles are not cast
    ):
        np.savez(path, **content)
        with pytest.raises(ValueError, match=rf"map\.npz.*{message}.*map again"):
            load_map(path)
    with pytest.raises(FileNotFoundError):
        load_map(tmp_path / "none.npz")


@pytest.mark.parametrize(
    ("where", "change", "message"),
    [
        (lambda m: m.gaussians.means, lambda a: a.at[1, 0].set(jnp.nan), "gaussians.means is not finite"),
        (lambda m: m.weight, lambda a: a.at[2].set(jnp.inf), "weight is not finite where there is a Gaussian"),
        (lambda m: m.weight, lambda a: a[:-1], r"weight is float32 \(4,\), expected float32 \(5,\)"),
        (lambda m: m.gaussians.covs, lambda a: a[:, :2], r"gaussians.covs is float32 \(5, 2, 3\), expected"),
        (lambda m: m.gaussians.colors, lambda a: a.astype(jnp.int8), r"gaussians.colors is int8 \(5, 3\), "),
        (lambda m: m.num_updates, lambda a: a.astype(jnp.int8), r"num_updates is int8 \(5,\), expected int32"),
        (lambda m: m.gaussians.means, lambda a: a.at[1, 0].set(1e30), "has a Gaussian 1e.06 m away or large"),
        (lambda m: m.gaussians.covs, lambda a: a.at[1].set(-jnp.eye(3)), "gaussians.covs has one that is no"),
        (lambda m: m.gaussians.covs, lambda a: a.at[1, 0, 1].set(0.5), "gaussians.covs has one that is no"),
        (lambda m: m.gaussians.valid, lambda a: a.astype(jnp.int32), "is no map: gaussians.valid is int32"),
        (lambda m: m.gaussians.valid, lambda a: a[None], r"is no map: gaussians.valid is bool \(1, 5\)"),
    ],
)
def test_a_map_with_other_shapes_dtypes_or_numbers_is_refused(tmp_path, where, change, message):
    """It was loaded as it was, and failed or was wrong somewhere later."""
    wrong = eqx.tree_at(where, a_map(), replace_fn=change)
    with pytest.raises(ValueError, match=rf"map\.npz.* {message}.*map again"):
        check_map("map.npz", wrong)
    save_map(tmp_path / "map.npz", wrong)
    with pytest.raises(ValueError, match=rf"map\.npz.* {message}.*map again"):
        load_map(tmp_path / "map.npz")

"""Oracles: bit-for-bit reloading, and every damage is noticed."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussian_map import empty_map
from emgs_jax.io.map_file import check_map, load_map, load_map_npz, save_map, save_map_npz


class Leaves(eqx.Module):
    """Stands in for Gaussians."""

    means: Float[Array, "n 3"]
    features: Float[Array, "n f"]
    valid: Bool[Array, " n"]
    model: str = eqx.field(static=True, default="dino")


class Map(eqx.Module):
    """Stands in for GaussianMap: a nested module, bookkeeping and a static field."""

    gaussians: Leaves
    gain: Float[Array, " n"]
    count: Int[Array, ""]
    capacity: int = eqx.field(static=True)


class Other(eqx.Module):
    gain: Float[Array, " n"]


def a_map(n=5, f=2):
    means = jnp.asarray(np.random.default_rng(0).normal(size=(n, 3)), jnp.float32).at[0, 0].set(jnp.nan)
    gaussians = Leaves(means, jnp.ones((n, f), jnp.float16), jnp.arange(n) % 2 == 0, "clip")
    return Map(gaussians, jnp.full(n, -0.0), jnp.asarray(3, jnp.int32), n)


def assert_same(a, b):
    assert jax.tree_util.tree_structure(a) == jax.tree_util.tree_structure(b)
    for x, y in zip(jax.tree_util.tree_leaves(a), jax.tree_util.tree_leaves(b), strict=True):
        assert (x.dtype, x.shape) == (y.dtype, y.shape)
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


@pytest.mark.parametrize("width", [0, 2])
def test_a_map_reloads_bit_for_bit_from_its_class_or_an_instance(tmp_path, width):
    tree = a_map(f=width)
    save_map_npz(tmp_path / "map.npz", tree)
    assert_same(load_map_npz(tmp_path / "map.npz", Map), tree)
    assert_same(load_map_npz(tmp_path / "map.npz", a_map(n=9)), tree)
    save_map_npz(tmp_path / "again.npz", tree)
    assert (tmp_path / "map.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()
    with np.load(tmp_path / "map.npz", allow_pickle=False) as arrays:
        assert set(arrays) == {
            *("gaussians.means", "gaussians.features", "gaussians.valid"),
            *("gain", "count", "__header__"),
        }


def test_truncated_or_flipped_maps_raise_value_error_or_hold_the_same(tmp_path):
    path = tmp_path / "map.npz"
    tree = a_map()
    save_map_npz(path, tree)
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
            assert_same(load_map_npz(path, Map), tree)
        except ValueError as error:
            rejected += 1
            assert "map.npz" in str(error)
    assert rejected > 250


def test_foreign_and_newer_maps_are_named_with_the_remedy(tmp_path):
    path = tmp_path / "map.npz"
    np.savez(path, gain=np.ones(3))
    with pytest.raises(ValueError, match=r"map\.npz is not a map of emgs_jax"):
        load_map_npz(path, Other)
    header = {"format": "emgs_jax.map", "version": 99, "class": "Other", "leaves": ["gain"], "static": {}}
    np.savez(path, __header__=np.array(json.dumps(header)), gain=np.ones(3))
    with pytest.raises(ValueError, match="map version 99, this code reads 3"):
        load_map_npz(path, Other)
    save_map_npz(path, a_map())
    with pytest.raises(ValueError, match="holds a Map, expected Other"):
        load_map_npz(path, Other)
    np.savez(path, __header__=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="not a readable map"):
        load_map_npz(path, Other)
    with pytest.raises(FileNotFoundError):
        load_map_npz(tmp_path / "none.npz", Other)
    with pytest.raises(ValueError, match="'gain' is float"):
        save_map_npz(path, Other(1.0))


def gaussian_map(num_features=2):
    """Three Gaussians in a map with room for five."""
    return eqx.tree_at(lambda m: m.gaussians.valid, empty_map(5, num_features), jnp.arange(5) < 3)


def test_a_map_of_gaussians_reloads_whatever_stands_in_rows_that_are_free_but_doubles_are_not_cast(tmp_path):
    path = tmp_path / "map.npz"
    poison = eqx.tree_at(lambda m: m.gaussians.means, gaussian_map(0), jnp.ones((5, 3)).at[4].set(jnp.nan))
    save_map(path, poison)
    assert_same(load_map(path), poison)
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **arrays | {"weight": arrays["weight"].astype(np.float64)})
    with pytest.raises(ValueError, match=r"map\.npz.*weight is float64.*map again"):
        load_map(path)


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
    wrong = eqx.tree_at(where, gaussian_map(), replace_fn=change)
    with pytest.raises(ValueError, match=rf"map\.npz.* {message}.*map again"):
        check_map("map.npz", wrong)
    save_map(tmp_path / "map.npz", wrong)
    with pytest.raises(ValueError, match=r"map\.npz.*map again"):  # here the types of all constructors are checked, too
        load_map(tmp_path / "map.npz")

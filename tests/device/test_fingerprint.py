"""Fingerprints of functions: every replacement of what they name changes them, and nothing else does."""

import functools
from types import FunctionType, SimpleNamespace

import equinox as eqx
import jax
import jaxlie
import numpy as np
import optimistix
import pytest

from emgs_jax import em, gaussians, slam
from emgs_jax.device.fingerprint import fingerprint
from emgs_jax.gaussian_map import AverageConfig
from emgs_jax.ops import neighbours

STEP = slam.step.__wrapped__


def with_cell(number):
    return lambda *given: (number, *given)


def soft(x, axis=-1, where=None):
    return x


def hard(x, axis=-1, where=None):
    return where


REPLACED = {
    "a stage": (slam, "extrapolate", lambda *given: given[0]),
    "a function that a stage calls": (em, "_explain", with_cell(1)),
    "a number": (em, "BLOCK", 8),
    "a tuple": (gaussians, "LUMINANCE", (0.3, 0.6, 0.1)),
    "an array in place of a tuple": (gaussians, "LUMINANCE", np.array([0.3, 0.6, 0.1], np.float32)),
    "a partial": (slam, "split", functools.partial(slam.split, noise=0.0)),
    "a helper of the lowest room": (neighbours, "ranks", with_cell(2)),
    "a default": (soft, "__defaults__", (1, None)),
    "the code of a function": (soft, "__code__", hard.__code__),
    "a property": (slam.SlamConfig, "fusion", property(lambda config: config)),
    "a function of JAX": (jax.nn, "softmax", soft),
    "one that is called as that of JAX": (jax.nn, "softmax", functools.wraps(jax.nn.softmax)(soft)),
    "another one of JAX": (jax.nn, "softmax", jax.nn.log_softmax),
    "a method of jaxlie": (jaxlie.SE3, "exp", staticmethod(lambda xi: xi)),
    "the solver": (optimistix, "LevenbergMarquardt", SimpleNamespace(step=1)),
}


@pytest.mark.parametrize("what", REPLACED)
def test_what_is_replaced_changes_the_fingerprint_until_it_is_put_back(monkeypatch, what):
    roots = STEP, slam.SlamConfig, soft
    before = fingerprint(*roots)
    with monkeypatch.context() as patch:
        patch.setattr(*REPLACED[what])
        assert fingerprint(*roots) != before
    assert fingerprint(*roots) == before is not None


def test_the_same_code_with_another_cell_is_another_function_and_a_copy_is_not():
    assert fingerprint(with_cell(1)) == fingerprint(with_cell(1)) != fingerprint(with_cell(2))
    copy = FunctionType(with_cell.__code__, globals(), "with_cell")
    assert fingerprint(copy) == fingerprint(with_cell) != fingerprint(soft)
    assert fingerprint(eqx.filter_jit(with_cell(1))) != fingerprint(eqx.filter_jit(with_cell(2)))


def test_a_class_is_told_by_its_methods_and_what_cannot_be_told_has_no_fingerprint():
    other = type("AverageConfig", (eqx.Module,), {"__call__": lambda self: 1, "__module__": AverageConfig.__module__})
    assert fingerprint(AverageConfig) != fingerprint(other)
    nothing = object()
    assert fingerprint(lambda: nothing) is None

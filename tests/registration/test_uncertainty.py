"""Uncertainty from the data: by level of confidence whatever its law, and by how alike the errors of an image are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emgs_jax.registration.noise import (
    NUM_CELLS,
    NUM_LEVELS,
    confidence_levels,
    noise_of_levels,
    num_independent,
    robust_std,
)

COUNT = 4096
ALL = jnp.ones(COUNT, bool)
RNG = np.random.default_rng(3)
STDS = np.exp(RNG.uniform(np.log(0.005), np.log(0.08), COUNT))  # of every point; no law of the simulator
ERRORS = jnp.asarray(STDS * RNG.normal(size=COUNT), jnp.float32)
LAWS = {  # any law that falls with the error has the same order
    "inverse": 1.0 + 0.01 / STDS,
    "exponential": 1.0 + 4.0 * np.exp(-STDS / 0.03),
    "cubic": 1.0 + 1e-6 / STDS**3,
}


def noise_of(confidence, errors=ERRORS, valid=ALL):
    levels = confidence_levels(jnp.asarray(confidence, jnp.float32), valid)
    return np.asarray(noise_of_levels(errors, valid, levels))[np.asarray(levels)]


@pytest.mark.parametrize("law", LAWS)
def test_points_get_the_noise_of_their_level_whatever_the_law(law):
    found = noise_of(LAWS[law])
    np.testing.assert_allclose(found, noise_of(LAWS["inverse"]), rtol=1e-6)
    ratio = found / STDS
    assert np.abs(np.log(ratio)).max() < 0.5 and len(np.unique(found)) == NUM_LEVELS


def test_a_constant_confidence_says_nothing():
    np.testing.assert_allclose(noise_of(np.full(COUNT, 7.0)), float(robust_std(ERRORS, ALL)), rtol=1e-6)


def test_high_confidence_of_wrong_points_is_found_out():
    """The order upside down: what claims to be best is known to be worst."""
    found = noise_of(STDS)
    np.testing.assert_allclose(found, noise_of(LAWS["inverse"]), rtol=0.2)  # cells may be cut elsewhere by one point


def test_a_level_with_few_points_takes_the_noise_of_all():
    confidence = jnp.where(jnp.arange(COUNT) < 10, 9.0, 1.0)
    levels = confidence_levels(confidence, ALL)
    noise = noise_of_levels(jnp.where(jnp.arange(COUNT) < 10, 1e-6, ERRORS), ALL, levels)
    np.testing.assert_allclose(noise[levels[0]], noise[0], rtol=0.02)


def test_invalid_points_and_nan_neither_count_nor_spread():
    valid = jnp.arange(COUNT) % 3 > 0
    spoilt = jnp.where(valid, ERRORS, 50.0)
    confidence = jnp.asarray(np.where(valid, LAWS["cubic"], 1e9), jnp.float32)
    levels = confidence_levels(confidence, valid)
    kept = np.asarray(valid)
    alone = confidence_levels(confidence[kept], ALL[: kept.sum()])
    np.testing.assert_array_equal(np.asarray(levels)[kept], alone)
    np.testing.assert_allclose(
        noise_of_levels(spoilt, valid, levels), noise_of_levels(ERRORS[kept], ALL[: kept.sum()], alone), rtol=1e-6
    )
    assert robust_std(ERRORS, ~ALL) == 0 and (noise_of_levels(ERRORS, ~ALL, levels) == 0).all()


@pytest.mark.parametrize("std", [0.01, 0.3])
def test_a_robust_std_is_that_of_gaussian_errors(std):
    errors = jnp.asarray(std * RNG.normal(size=COUNT), jnp.float32)
    np.testing.assert_allclose(robust_std(errors, ALL), std, rtol=0.05)
    np.testing.assert_allclose(robust_std(errors.at[:400].set(1e3), ALL), std, rtol=0.2)


def field(length: int) -> np.ndarray:
    """Errors on 64 × 64 pixels, alike in squares of `length` pixels."""
    blocks = RNG.normal(size=(64 // length, 64 // length))
    return np.kron(blocks, np.ones((length, length)))


GRID = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 64), np.linspace(-0.4, 0.4, 64)), -1).reshape(-1, 2)
DEPTH = RNG.uniform(1, 4, (COUNT, 1))
POINTS = jnp.asarray(np.hstack([GRID, np.ones((COUNT, 1))]) * DEPTH, jnp.float32)


@pytest.mark.parametrize("length", [1, 2, 4, 8])
def test_as_many_measurements_as_there_are_squares_of_like_errors(length):
    found = np.median([num_independent(field(length).reshape(-1) + 0 * ERRORS, POINTS, ALL) for _ in range(9)])
    np.testing.assert_allclose(found, (64 / length) ** 2, rtol=0.25)


def test_their_number_does_not_depend_on_the_unit_or_on_invalid_points_and_has_bounds():
    errors = jnp.asarray(field(4).reshape(-1), jnp.float32)
    found = num_independent(errors, POINTS, ALL)
    np.testing.assert_allclose(num_independent(1e-3 * errors, POINTS, ALL), found, rtol=1e-4)
    half = jnp.arange(COUNT) % 2 > 0
    spoilt = jnp.where(half, errors, 1e3), jnp.where(half[:, None], POINTS, jnp.nan)
    assert num_independent(spoilt[0], jnp.where(half[:, None], POINTS, 0.0), half) <= COUNT / 2
    assert num_independent(jnp.ones(COUNT), POINTS, ALL) == NUM_CELLS**2
    assert num_independent(errors, POINTS, ~ALL) == NUM_CELLS**2
    assert np.isfinite(jax.grad(lambda e: num_independent(e, POINTS, ALL))(jnp.zeros(COUNT))).all()

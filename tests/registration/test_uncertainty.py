"""Uncertainty from the data: by level of confidence whatever its law, and by how alike the errors of an image are."""

import jax
import numpy as np
import pytest
from scene import on_host

from emgs_jax.registration import noise
from emgs_jax.registration.noise import NUM_CELLS, NUM_LEVELS

noise_of_levels, num_independent, robust_std = (
    on_host(f) for f in (noise.noise_of_levels, noise.num_independent, noise.robust_std)
)
COUNT = 4096
ALL = np.ones(COUNT, bool)
RNG = np.random.default_rng(3)
STDS = np.exp(RNG.uniform(np.log(0.005), np.log(0.08), COUNT))  # of every point; no law of the simulator
ERRORS = np.float32(STDS * RNG.normal(size=COUNT))
LAWS = {  # any law that falls with the error has the same order
    "inverse": 1.0 + 0.01 / STDS,
    "exponential": 1.0 + 4.0 * np.exp(-STDS / 0.03),
    "cubic": 1.0 + 1e-6 / STDS**3,
}


@on_host
def confidence_levels(confidence, valid):
    return noise.levels_of(confidence, noise.level_edges(confidence, valid))


def noise_of(confidence, errors=ERRORS, valid=ALL):
    levels = confidence_levels(np.float32(confidence), valid)
    return noise_of_levels(errors, valid, levels)[1][levels]


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
    is_best = np.arange(COUNT) < 10
    levels = confidence_levels(np.float32(np.where(is_best, 9.0, 1.0)), ALL)
    _, found = noise_of_levels(np.where(is_best, np.float32(1e-6), ERRORS), ALL, levels)
    np.testing.assert_allclose(found[levels[0]], found[0], rtol=0.02)


def test_invalid_points_and_nan_neither_count_nor_spread():
    valid = np.arange(COUNT) % 3 > 0
    spoilt = np.where(valid, ERRORS, np.float32(50.0))
    confidence = np.float32(np.where(valid, LAWS["cubic"], 1e9))
    levels = confidence_levels(confidence, valid)
    alone = confidence_levels(confidence[valid], ALL[: valid.sum()])
    np.testing.assert_array_equal(levels[valid], alone)
    of_all, expected = noise_of_levels(ERRORS[valid], ALL[: valid.sum()], alone)
    found = noise_of_levels(spoilt, valid, levels)
    np.testing.assert_allclose(found[1], expected, rtol=1e-6)
    np.testing.assert_allclose([found[0], of_all], robust_std(ERRORS[valid], ALL[: valid.sum()]), rtol=1e-6)
    assert robust_std(ERRORS, ~ALL) == 0 and (noise_of_levels(ERRORS, ~ALL, levels)[1] == 0).all()


@pytest.mark.parametrize("std", [0.01, 0.3])
def test_a_robust_std_is_that_of_gaussian_errors(std):
    errors = np.float32(std * RNG.normal(size=COUNT))
    np.testing.assert_allclose(robust_std(errors, ALL), std, rtol=0.05)
    errors[:400] = 1e3
    np.testing.assert_allclose(robust_std(errors, ALL), std, rtol=0.2)


def field(length: int) -> np.ndarray:
    """Errors on 64 × 64 pixels, alike in squares of `length` pixels."""
    blocks = RNG.normal(size=(64 // length, 64 // length))
    return np.kron(blocks, np.ones((length, length)))


GRID = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 64), np.linspace(-0.4, 0.4, 64)), -1).reshape(-1, 2)
DEPTH = RNG.uniform(1, 4, (COUNT, 1))
POINTS = np.float32(np.hstack([GRID, np.ones((COUNT, 1))]) * DEPTH)


@pytest.mark.parametrize("length", [1, 2, 4, 8])
def test_as_many_measurements_as_there_are_squares_of_like_errors(length):
    found = np.median([num_independent(np.float32(field(length).reshape(-1)), POINTS, ALL) for _ in range(9)])
    np.testing.assert_allclose(found, (64 / length) ** 2, rtol=0.25)


def test_their_number_does_not_depend_on_the_unit_or_on_invalid_points_and_has_bounds():
    errors, half = np.float32(field(4).reshape(-1)), np.arange(COUNT) % 2 > 0
    found = num_independent(errors, POINTS, ALL)
    np.testing.assert_allclose(num_independent(np.float32(1e-3) * errors, POINTS, ALL), found, rtol=1e-4)
    wild = np.where(half, errors, np.float32(1e3)), np.where(half[:, None], POINTS, np.float32(0.0))
    np.testing.assert_allclose(num_independent(*wild, half), found, rtol=0.3)  # half of each square of 4 x 4 errors
    assert num_independent(np.ones(COUNT, np.float32), POINTS, ALL) == NUM_CELLS**2
    assert num_independent(errors, POINTS, ~ALL) == NUM_CELLS**2
    slope = on_host(jax.grad(noise.num_independent))(np.zeros(COUNT, np.float32), POINTS, ALL)
    assert np.isfinite(slope).all()

"""What two answers about one pose differ by: against answers whose errors are drawn, with a part of them in common."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scene import device, matrix_of, on_host, pose, pose_of, product, random_observation, stack_poses
from scipy.spatial.transform import Rotation

from emgs_jax.observation import Prediction, no_covariance
from emgs_jax.registration import pose_noise
from emgs_jax.registration.pose_noise import Repeats, no_repeats, repeat_poses, rescale_repeats

STEP, DEPTH, MEMORY = pose((0.03, -0.02, 0.05), (0.2, 0.05, -0.1)), 2.5, 10.0
MOTION, OWN = (0.01, 0.004), (0.03, 0.02)  # standard deviations: lengths in mean depths, rad
STILL = pose()


@on_host
def repeat(prediction, before, scale):
    """What is said again, in the unit of its answer and of the world."""
    repeats, latest = repeat_poses(prediction, before, scale, jnp.asarray(DEPTH), jnp.asarray(MEMORY))
    return rescale_repeats(repeats, scale), repeats, latest


axis_std, pose_std = on_host(pose_noise.axis_std), on_host(pose_noise.pose_std)


def power(count: int) -> jaxlie.SE3:
    """Where the camera is after so many steps."""
    return product(*[STEP] * count)


def drawn(rng: np.random.Generator, std: tuple[float, float], common: np.ndarray, shared: float) -> jaxlie.SE3:
    """A disturbance whose variance has the part `shared` of it in `common`, (6,) normal."""
    xi = np.sqrt(shared) * common + np.sqrt(1 - shared) * rng.normal(size=6)
    xi *= np.repeat([DEPTH * std[0], std[1]], 3)
    # Of a small turn by ω the logarithm's translation is that of the motion, but for half of ω × t.
    turn = Rotation.from_rotvec(xi[3:])
    return pose(turn.as_rotvec(), xi[:3] + 0.5 * np.cross(xi[3:], xi[:3]))


def answer(
    number: int, own: jaxlie.SE3, motions: tuple[jaxlie.SE3, jaxlie.SE3], scale: float = 1.0, **more
) -> Prediction:
    """What is said of frames number - 1, number and number + 1, in a unit of which `scale` are one metre."""
    anchor = pose((0, 0.7, 0), (3, 1, 2))
    previous = product(power(number - 1), own)
    views = [previous, product(previous, motions[0]), product(previous, *motions)]
    flags = {"has_newest": True, "is_repeat": True} | more
    return Prediction(
        NOTHING,
        NOTHING,
        stack_poses([product(anchor, scaled(T, scale)) for T in views]),
        anchor,
        no_covariance(),
        device(np.float32(np.nan)),
        *(device(flags[name]) for name in ("has_newest", "is_repeat")),
    )


def scaled(T: jaxlie.SE3, scale: float) -> jaxlie.SE3:
    matrix = matrix_of(T)
    matrix[:3, 3] *= scale
    return pose_of(matrix)


NOTHING = random_observation(4)


def exact(number: int, **more) -> Prediction:
    return answer(number, STILL, (STEP, STEP), **more)


def said_again(before: Repeats, prediction: Prediction, scale: float = 1.0) -> tuple[Repeats, jax.Array]:
    repeats, _, latest = repeat(prediction, before, np.float32(1 / scale))
    return repeats, latest


@pytest.mark.slow
def test_the_deviations_are_those_of_the_answers():
    """400 frames whose answers have three quarters of their variance in common."""
    rng, shared, repeats = np.random.default_rng(0), 0.75, no_repeats()
    common = {name: rng.normal(size=(402, 6)) for name in ("motion", "own")}
    found, latests = [], []
    for number in range(1, 401):
        own = drawn(rng, OWN, common["own"][0], shared)  # of all frames alike: the difference is that of one pose
        motions = tuple(product(STEP, drawn(rng, MOTION, common["motion"][number + k], shared)) for k in (0, 1))
        repeats, latest = said_again(repeats, answer(number, own, motions))
        found.append(pose_std(repeats, np.zeros((2, 2), np.float32), np.float32(0.01), np.float32(shared)))
        latests.append(latest)
    # The pose of a frame is that of the one before and the motion here, and its own there: the motion's error is in it.
    guess, weight = 0.01, 1 / (MEMORY + 1)
    expected = np.array([MOTION, np.hypot(OWN, np.array(MOTION) / np.sqrt(2 * (1 - shared)))])
    found = np.exp(np.mean(np.log(np.array(found[20:])), axis=0))
    np.testing.assert_allclose(found, expected ** (1 - weight) * guess**weight, rtol=0.05)
    assert np.array(latests[1:]).min() > 0


def test_an_answer_that_is_the_same_again_says_nothing_whatever_its_unit():
    """A prior with one pose for every frame, such as `files`, does not contradict itself, and may be wrong."""
    repeats = no_repeats()
    for number, scale in enumerate((1.0, 1.3, 0.4, 1.0), start=1):
        repeats, latest = said_again(repeats, exact(number, scale=scale), scale)
        assert not np.any(latest)
    np.testing.assert_array_equal(repeats.counts, [0, 0])
    for values, expected in zip(repeats.predicted.wxyz_xyz, (STEP, power(4)), strict=True):
        np.testing.assert_allclose(matrix_of(jaxlie.SE3(values)), matrix_of(expected), atol=1e-5)


def test_a_difference_is_in_mean_depths_and_radians():
    shift, turn = pose((0, 0, 0), (0.3, 0, 0)), pose((0.1, 0, 0), (0, 0, 0))
    repeats, _ = said_again(no_repeats(), exact(1))
    for change, expected in ((shift, [0.3 / DEPTH, 0]), (turn, [0, 0.1])):
        _, latest = said_again(repeats, answer(2, STILL, (product(STEP, change), STEP)))
        np.testing.assert_allclose(np.sqrt(3 * latest[0]), expected, atol=1e-4)
        assert np.all(latest[1] < 1e-9)
        _, latest = said_again(repeats, answer(2, change, (STEP, STEP)))
        np.testing.assert_allclose(np.sqrt(3 * latest[1]), expected, atol=1e-4)
        assert np.all(latest[0] < 1e-9)


@pytest.mark.parametrize(
    ("first", "second", "counts"),
    [
        ({}, {}, [1, 1]),
        ({"has_newest": False}, {}, [0, 1]),  # the end of a window, which says no motion that comes
        ({}, {"is_repeat": False}, [0, 0]),  # the same answer, or a frame that is its own previous one
    ],
)
def test_what_is_not_said_twice_does_not_count(first, second, counts):
    before, _ = said_again(no_repeats(), exact(1, **first))
    np.testing.assert_array_equal(before.counts, [0, 0])
    after, latest = said_again(before, answer(2, pose((0, 0.1, 0), (1, 0, 0)), (power(2), STEP), **second))
    np.testing.assert_array_equal(after.counts, counts)
    np.testing.assert_array_equal(np.any(latest > 0, axis=1), np.array(counts) > 0)


def test_a_pose_that_is_no_number_does_not_count_and_leaves_no_trace():
    before, _ = said_again(no_repeats(), exact(1))
    lost = eqx.tree_at(lambda p: p.T_world_views, exact(2), jaxlie.SE3(device(np.full((3, 7), np.nan))))
    after, latest = said_again(before, lost)
    assert not np.any(latest) and np.all(np.isfinite(after.log_squares))
    np.testing.assert_array_equal(after.counts, [0, 0])
    again, latest = said_again(after, exact(3))
    np.testing.assert_array_equal(again.counts, [0, 0])
    assert not np.any(latest)


def test_older_repeats_are_forgotten():
    """Ten of one size, then thirty of another: the mean is of the last ones, (1 - 1/10)^30 of the way there."""
    small, large, repeats = 0.01, 0.1, no_repeats()
    said, _ = said_again(no_repeats(), exact(1))
    for size in [small] * 10 + [large] * 30:
        before = Repeats(said.predicted, *map(device, (said.is_predicted, repeats.log_squares, repeats.counts)))
        repeats, _ = said_again(before, answer(2, STILL, (product(STEP, pose((0, 0, 0), (size, 0, 0))), STEP)))
    assert float(repeats.counts[0]) == MEMORY
    logs = np.log([size**2 / 3 / DEPTH**2 for size in (small, large)])
    expected = logs[1] + 0.9**30 * (logs[0] - logs[1])
    assert float(repeats.log_squares[0, 0]) == pytest.approx(expected, abs=0.01)


def test_without_repeats_the_depths_say_it_and_one_guess_counts_like_one_repeat():
    nothing, guess, shared = np.zeros((2, 2), np.float32), np.float32(0.02), np.float32(0.5)
    np.testing.assert_allclose(pose_std(no_repeats(), nothing, guess, shared), 0.02 * np.ones((2, 2)), rtol=1e-5)
    logs, counts = np.full((2, 2), np.log(0.001**2) - 0.36898), np.array([3.0, 0.0])
    known = replace(no_repeats(), log_squares=device(logs), counts=device(counts))
    std = pose_std(known, nothing, guess, shared)
    np.testing.assert_allclose(std[0], 0.001 ** (3 / 4) * 0.02 ** (1 / 4), rtol=1e-4)
    np.testing.assert_allclose(std[1], 0.02, rtol=1e-5)
    printed = pose_std(known, np.ones((2, 2), np.float32), guess, np.float32(1.0))
    np.testing.assert_array_equal(printed, np.float32(0.02) * np.ones((2, 2), np.float32))
    # What is in common does not show: a quarter of the variance differs, and twice that is what two differ by.
    std = pose_std(known, nothing, guess, np.float32(0.75))
    np.testing.assert_allclose(std[0], (0.001 * 2**0.5) ** (3 / 4) * 0.02 ** (1 / 4), rtol=1e-4)


def test_along_the_axes_lengths_are_in_mean_depths_and_what_is_informed_of_is_surer():
    """Of the motion and of the pose itself: three lengths, then three angles; nine depths are worth a third of one."""
    latest, shared = np.float32([[0.1**2, 0.0], [0.3**2, 0.4**2]]), np.float32(0.5)
    lengths, angles = pose_std(no_repeats(), latest, np.float32(0.01), shared).T
    given = np.float32(0.03), np.float32(DEPTH), np.float32(9.0), shared
    expected = np.stack([DEPTH * lengths] * 3 + [angles] * 3, axis=1)
    np.testing.assert_allclose(axis_std(no_repeats(), latest, *given), expected, rtol=1e-5)


def test_a_pose_is_at_least_as_uncertain_as_its_own_repeat_differs():
    latest = np.float32([[0.1**2, 0.0], [0.0, 0.2**2]])
    std = pose_std(no_repeats(), latest, np.float32(0.01), np.float32(0.75))
    np.testing.assert_allclose(std, [[0.1 * 2**0.5, 0.01], [0.01, 0.2 * 2**0.5]], rtol=1e-5)


def test_the_deviations_have_a_finite_gradient_where_answers_agree_and_where_there_are_none():
    given = answer(2, STILL, (STEP, STEP))

    @on_host
    def slope(shift, before):
        def total(shift):
            moved = jaxlie.SE3(given.T_world_views.wxyz_xyz.at[1:, 4:].add(shift))
            prediction = eqx.tree_at(lambda p: p.T_world_views, given, moved)
            repeats, latest = repeat_poses(prediction, before, jnp.ones(()), jnp.asarray(DEPTH), jnp.asarray(MEMORY))
            return jnp.sum(pose_noise.pose_std(repeats, latest, jnp.asarray(0.01), jnp.asarray(0.75)))

        return jax.grad(total)(shift)

    for before in (no_repeats(), said_again(no_repeats(), exact(1))[0]):
        assert np.isfinite(slope(np.zeros(3, np.float32), before)).all()


def test_a_covariance_that_is_given_is_brought_into_the_maps_unit_and_the_other_is_the_guess():
    factor, unit, depth, guess = np.random.default_rng(0).normal(size=(6, 6)), 2.0, 3.0, np.linspace(0.1, 0.6, 12)
    given = np.float32([0.01 * factor @ factor.T, np.full((6, 6), np.nan)])
    found = on_host(pose_noise.pose_covariances)(given, np.float32(guess.reshape(2, 6)), *map(device, (depth, unit)))
    units, least = np.repeat([unit, 1.0], 3), pose_noise.LEAST_NOISE * np.repeat([depth, 1.0], 3)
    np.testing.assert_allclose(found[0], units[:, None] * given[0] * units + np.diag(least**2), rtol=1e-5)
    np.testing.assert_allclose(found[1], np.diag(guess[6:] ** 2), rtol=1e-5)
    tiny = on_host(pose_noise.pose_covariances)(
        0 * given[[0, 0]], np.float32(np.ones((2, 6))), *map(device, (depth, unit))
    )
    np.testing.assert_allclose(tiny, np.tile(np.diag(least**2), (2, 1, 1)), rtol=1e-5)

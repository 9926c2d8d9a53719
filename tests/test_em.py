"""E-step, M-step and support against NumPy and closed limits: sums, textbook mixtures, one-hot assignments, gates."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import scene as sc

from emgs_jax.em import e_step, em_update, m_step, precision, support
from emgs_jax.ops.linalg import whiten, whitening, widened_distance_sq

M, N, F = 60, 40, 3
POINTS, GAUSSIANS = sc.random_observation(M, num_features=F), sc.random_gaussians(N, num_features=F)
QUIET = np.zeros((M, 3), np.float32)
NOISE = (np.random.default_rng(5).normal(size=(M, 3)) * 0.1).astype(np.float32)
estep, mstep, supported, updated_map = (sc.on_host(f) for f in (e_step, m_step, support, em_update))


@sc.on_host
def widened(triangle, offsets, noise):
    return widened_distance_sq(whiten(triangle, offsets), whiten(triangle, noise))


def em(*arguments):
    """The updated map, which points were fused, and counts."""
    map, step, info = updated_map(*arguments)
    return map, step.is_fused, info


MAP = sc.fresh_map(GAUSSIANS)

PAPER = ("slam/em=paper", "slam/fit=paper")
OPEN = {"min_normal_cos": -1.0, "max_mahalanobis_sq": np.inf, "max_log_gap": np.inf, "noise": 0.0}


@pytest.fixture(scope="module")
def paper(config):
    return config(*PAPER).em


@pytest.fixture(scope="module")
def opened(paper):
    """All gates open, no noise, every sum counts."""
    return sc.changed(paper, **OPEN, min_responsibility=0.0)


def dense(step):
    """Responsibilities as an (m, n) matrix."""
    return sc.shares_of(step, N)


def arrays(points):
    return tuple(np.asarray(x, float) for x in (points.points, points.normals, points.features))


READINGS = {
    "printed": {"support": 0.0, "determinant_weight": 1.0, "average.gain": 0.0, "noise": 0.0, "max_log_gap": 30.0},
    "default": {"support": 1.0, "determinant_weight": 0.5, "average.gain": 1.0, "noise": 1.0, "max_log_gap": 20.0},
    "half the noise": {"support": 1.0, "determinant_weight": 0.5, "average.gain": 1.0, "noise": 0.5},
    "few points": {"min_responsibility": 1.5, "average.forgetting": 0.7, "noise": 2.0},
}


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("num_valid", [N, 4])
def test_an_update_equals_equations_2_to_4_one_item_at_a_time(paper, reading, num_valid):
    """With four valid Gaussians a point has fewer neighbours than it asks for."""
    gates = {"min_normal_cos": 0.85, "max_mahalanobis_sq": 60.0, "min_responsibility": 0.1}
    config = sc.changed(paper, **(gates | READINGS[reading]))
    weight, gaussians = np.linspace(0.5, 3.0, N), sc.replace(GAUSSIANS, valid=np.arange(N) % (N // num_valid) == 0)
    map, points = sc.fresh_map(gaussians, weight), sc.replace(POINTS, valid=np.arange(M) % 9 > 0)
    updated, is_fused, info = em(map, points, NOISE, config)
    observed = (*arrays(points), *(np.asarray(x, float) for x in (points.colors, NOISE)), np.asarray(points.valid))
    rows, fused, log_joint = reference.em_update(*observed, sc.as_numpy(map.gaussians), weight, config)
    np.testing.assert_array_equal(is_fused, fused)
    assert 0 < fused.sum() < observed[-1].sum() and len(rows) > 0
    assert (info.num_points, info.num_fused, info.num_updated) == (observed[-1].sum(), fused.sum(), len(rows))
    assert info.mean_log_joint == pytest.approx(log_joint, rel=1e-4)  # a mean of numbers up to 50 in float32
    g = updated.gaussians
    for k, expected in rows.items():
        # Exponents near 60 lose 1e-5 each in float32, and shares are divided by totals down to .1.
        for a, b in zip((g.means[k], g.covs[k], g.normals[k], g.colors[k], updated.weight[k]), expected, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-3)
    others = np.setdiff1d(np.arange(N), list(rows))
    sc.assert_same(sc.rows_of(updated, others), sc.rows_of(map, others))
    np.testing.assert_array_equal(updated.num_updates[np.array(list(rows))], 2)


def test_features_of_width_zero_are_as_good_as_a_zero_weight(opened):
    bare = lambda x: sc.replace(x, features=np.zeros((x.valid.shape[0], 0)))  # noqa: E731
    without, _ = estep(bare(GAUSSIANS), bare(POINTS), QUIET, opened)
    unweighted, _ = estep(GAUSSIANS, POINTS, QUIET, sc.changed(opened, feature_weight=0.0))
    np.testing.assert_allclose(without.responsibilities, unweighted.responsibilities, atol=1e-6)


@pytest.mark.parametrize("missing", ["points", "gaussians"])
def test_a_missing_feature_says_nothing(paper, missing):
    """Every other point or Gaussian without a feature: there the term is 0, elsewhere what it was."""
    config = sc.changed(paper, max_mahalanobis_sq=60.0, max_log_gap=20.0)
    points, gaussians = POINTS, GAUSSIANS
    blank = lambda x: sc.replace(x, features=x.features * np.float32(np.arange(len(x.valid)) % 2)[:, None])  # noqa: E731
    if missing == "points":
        points = blank(points)
    else:
        gaussians = blank(gaussians)
    step, best = estep(gaussians, points, QUIET, config)
    known, _ = estep(GAUSSIANS, POINTS, QUIET, config)
    without, best_without = estep(GAUSSIANS, POINTS, QUIET, sc.changed(config, feature_weight=0.0))
    expected, is_fused, joint = reference.e_step(
        *arrays(points), np.asarray(QUIET), np.ones(M, bool), sc.as_numpy(gaussians), config
    )
    np.testing.assert_array_equal(step.is_fused, is_fused)
    np.testing.assert_allclose(dense(step), expected, atol=1e-3)  # exponents near 60 lose 1e-5 each in float32
    if missing == "points":
        np.testing.assert_allclose(best[::2], best_without[::2], atol=1e-5)
        np.testing.assert_array_equal(*(dense(s)[1::2] for s in (step, known)))
    assert 0 < is_fused.sum() < M


def test_a_share_that_vanishes_moves_nothing(paper):
    """A responsibility of 3e-38 times a precision of .01 is 0 in float32, and 0 / 0 was the new mean."""
    step, _ = estep(GAUSSIANS, POINTS, QUIET, sc.changed(paper, **OPEN))
    vanishing = sc.replace(step, responsibilities=np.full(step.responsibilities.shape, 3e-38))
    weights = np.full(M, 0.01, np.float32)
    new, total = mstep(GAUSSIANS, POINTS, weights, vanishing, sc.changed(paper, min_responsibility=0.0))
    sc.assert_same(new, sc.rows_of(GAUSSIANS, slice(None)))
    assert (total < 1e-35).all()


FLAT = np.diag([0.04, 0.01, 0.0001])  # principal axes x, y; normal z


def support_of(positions, weights, config, kind):
    """δ of one flat Gaussian at the origin under points with given responsibilities; the other points have none."""
    count, given = len(positions), np.zeros((M, 3))
    given[:count] = positions
    g = sc.replace(
        GAUSSIANS, means=np.zeros((N, 3)), covs=np.tile(FLAT, (N, 1, 1)), normals=np.tile([0, 0, 1.0], (N, 1))
    )
    shares = np.zeros((M, config.num_neighbours), np.float32)
    shares[:count, 0] = weights
    step = sc.explained(np.zeros(shares.shape), shares, np.arange(M) < count)
    config = sc.changed(config, support={"printed": 0, "normalized": 1}[kind])
    return float(supported(g, sc.replace(POINTS, points=given), step, config)[0])


CORNERS = [(1, 1, 0), (1, -1, 0), (-1, 1, 0), (-1, -1, 0)]


@pytest.mark.parametrize(
    ("weights", "printed", "normalized"),
    [
        ([0.1, 0.1, 0.1, 0.1], 0.4, 1.0),  # even support: 2 min(.2, .2)
        ([0.3, 0.3, 0.1, 0.1], 0.4, 0.5),  # one-sided in x: 2 min(.6, .2), of .8
        ([0.3, 0.1, 0.3, 0.1], 0.4, 0.5),  # one-sided in y
        ([0.5, 0.5, 0.0, 0.0], 0.0, 0.0),  # nothing on one side
        ([1.0, 1.0, 1.0, 1.0], 1.0, 1.0),  # 4 is clipped to 1
        ([0.0, 0.0, 0.0, 0.0], 0.0, 0.0),  # no support at all
    ],
)
def test_support_has_its_literal_values(opened, weights, printed, normalized):
    assert support_of(CORNERS, weights, opened, "printed") == pytest.approx(printed, abs=1e-6)
    assert support_of(CORNERS, weights, opened, "normalized") == pytest.approx(normalized, abs=1e-6)


def test_what_nothing_explains_adds_its_feature_to_nothing(opened):
    is_far = np.arange(M) % 2 == 0
    points = sc.replace(POINTS, points=np.asarray(POINTS.points) + 100.0 * is_far[:, None])
    updated, is_fused, _ = em(MAP, points, QUIET, sc.changed(opened, feature=1.0, max_mahalanobis_sq=60.0))
    assert is_fused[~is_far].sum() > 10 and not is_fused[is_far].any()
    added = np.asarray(updated.gaussians.features) - np.asarray(GAUSSIANS.features)
    np.testing.assert_allclose(added.sum(axis=0), np.asarray(POINTS.features)[is_fused].sum(axis=0), rtol=1e-4)


def test_points_along_the_normal_do_not_count_as_sides(opened):
    above_and_below = [(1, 1, 5), (1, 1, -5)]
    assert support_of(above_and_below, [1.0, 1.0], opened, "normalized") == 0


def test_accumulated_features_are_those_of_all_points_that_a_gaussian_explains_best(opened):
    step, _ = estep(GAUSSIANS, POINTS, QUIET, opened)
    best = dense(step).argmax(axis=1)
    expected = np.array(GAUSSIANS.features)
    np.add.at(expected, best, np.asarray(POINTS.features))
    printed, _, _ = em(MAP, POINTS, QUIET, opened)
    sc.assert_same(printed.gaussians.features, GAUSSIANS.features)  # as printed, they are those of the creation
    updated, _, _ = em(MAP, POINTS, QUIET, sc.changed(opened, feature=1.0))
    np.testing.assert_allclose(updated.gaussians.features, expected, rtol=1e-5)
    longer = sc.fresh_map(sc.replace(GAUSSIANS, features=7.0 * np.asarray(GAUSSIANS.features)))
    _, _, info = em(MAP, POINTS, QUIET, opened)
    np.testing.assert_allclose(em(longer, POINTS, QUIET, opened)[2].mean_log_joint, info.mean_log_joint, rtol=1e-5)


@pytest.mark.slow  # compiles the update anew
def test_many_points_are_taken_in_parts_which_changes_no_average(opened):
    """The same points again and again, more than are held at once: sums grow, shares and means stay."""
    config, times = sc.changed(opened, **{"support": 1.0, "noise": 1.0, "average.gain": 1.0}), 300
    expected, is_fused, info = em(MAP, POINTS, NOISE, config)
    again = np.tile(np.arange(M), times)
    updated, all_fused, many = em(MAP, sc.rows_of(POINTS, again), NOISE[again], config)
    np.testing.assert_array_equal(all_fused, is_fused[again])
    assert many.num_points == times * M > 16384 and many.num_updated == info.num_updated
    np.testing.assert_allclose(many.mean_log_joint, info.mean_log_joint, rtol=1e-4)
    np.testing.assert_allclose(updated.weight, expected.weight, atol=1e-4)  # sums of 300 times as many, here and below
    sc.assert_rows_near(updated.gaussians, expected.gaussians, atol=1e-4)


def test_an_empty_submap_fuses_nothing_and_stays_finite(paper):
    empty = sc.fresh_map(sc.replace(GAUSSIANS, valid=np.zeros(N, bool)))
    updated, is_fused, info = em(empty, POINTS, QUIET, paper)
    assert not is_fused.any() and info.mean_log_joint == 0
    sc.assert_same(updated, empty)


# How much a point counts.


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_precision_is_the_share_of_the_floor_in_a_points_variance(paper, noise):
    config = sc.changed(paper, noise=noise, min_std=0.01)
    found = sc.on_host(precision)(np.float32([[0.0, 0, 0], [0.006, 0, 0.008], [0, 0.1, 0]]), config)
    np.testing.assert_allclose(found, [1, 0.5, 1 / 101] if noise else [1, 1, 1], rtol=1e-6)


@pytest.mark.parametrize(("noise", "depth"), [(0.02, 3e3), (0.1, 1e4), (0.3, 1e4)])
def test_a_distant_point_behind_a_gaussian_is_judged_as_in_float64(noise, depth):
    """The difference of two terms of 1e12 was clipped to 0, and points of a sky were fused into a wall at 2 m."""
    rays = np.random.default_rng(0).uniform(-0.4, 0.4, (M, 3)) * [1, 1, 0] + [0, 0, 1]
    points, mean, cov = np.float32(depth * rays), np.float32([0.1, 0, 2]), np.float32(np.diag([0.05, 0.05, 0.01]) ** 2)
    along = np.float32(noise) * points
    triangle = tuple(jnp.unstack(whitening(jnp.asarray(cov))[0]))
    found, growth = widened(triangle, tuple((points - mean).T), tuple(along.T))
    offsets, along = points.astype(float) - mean, along.astype(float)
    whole = cov + along[:, :, None] * along[:, None]
    exact = np.einsum("ni,nij,nj->n", offsets, np.linalg.inv(whole), offsets)
    np.testing.assert_allclose(found, exact, rtol=0.02)  # a point is rounded by .06 of the least deviation
    np.testing.assert_allclose(growth, np.linalg.slogdet(whole)[1] - np.linalg.slogdet(cov)[1], rtol=1e-5)


POISON = {
    "colour": ("colors", np.nan),
    "normal": ("normals", np.inf),
    "feature": ("features", np.nan),
    "confidence": ("confidence", np.inf),
    "point": ("points", np.nan),
    "point beyond any map": ("points", 1e18),
    "noise": ("noise", np.inf),
}


@pytest.mark.parametrize("what", POISON)
def test_a_point_with_a_number_that_is_none_is_left_out(paper, what):
    """One colour of 80 that was NaN made those of 36 of 40 Gaussians NaN."""
    name, value = POISON[what]
    values = np.array(getattr(POINTS, name, NOISE))
    values.reshape(M, -1)[7, -1] = value
    points, noise = (POINTS, values) if name == "noise" else (sc.replace(POINTS, **{name: values}), NOISE)
    config = sc.changed(paper, min_normal_cos=0.85, max_mahalanobis_sq=60.0)
    expected = em(MAP, sc.replace(POINTS, valid=np.arange(M) != 7), NOISE, config)
    sc.assert_same(em(MAP, points, noise, config), expected)


@pytest.mark.slow
def test_where_a_gaussian_has_a_vanishing_share_its_support_has_finite_slopes(paper):
    """1e-21 over 1e-21: the slopes of the ratio overflow."""
    gaussians, points = sc.join(sc.rows_of(GAUSSIANS, [0, 0])), sc.join(sc.rows_of(POINTS, [0, 1]))

    def total(shares):
        step = sc.explained([[0, 1], [0, 1]], np.ones((2, 2)), [True, True])
        return jnp.sum(support(gaussians, points, eqx.tree_at(lambda s: s.responsibilities, step, shares), paper))

    assert np.isfinite(jax.grad(total)(jnp.asarray([[[1.0, 1e-21]], [[1.0, 1e-23]]]))).all()

"""Coarse readings recover an exact chain, scales are found, every guard keeps the coarse pose and says why."""

import equinox as eqx
import jax
import jaxlie
import numpy as np
import pytest
import scene as sc

from emgs_jax.gaussians import fit_to_points
from emgs_jax.localization import REASONS, localize_coarse, localize_fine
from emgs_jax.ops.camera import Camera
from emgs_jax.registration.depth_field import field_at
from emgs_jax.registration.icp import icp
from emgs_jax.registration.pose_estimate import exact_estimate, root_information
from emgs_jax.registration.pose_noise import no_repeats
from emgs_jax.registration.problem import CoarseStart
from emgs_jax.registration.repeated_prediction import repeat_scale

coarse_step, fine_step, solve = (sc.on_host(f) for f in (localize_coarse, localize_fine, icp))
COARSE = {"via_previous": 0, "same_image": 1, "anchored": 2, "fused": 3}
SCALES = {"none": 0, "ratio": 1, "estimated": 2}
FRAME = 3
CERTAIN = jax.device_get(exact_estimate())


@pytest.fixture(scope="module")
def wide():
    """Twice the resolution: closest points of the previous image are then a few centimetres apart."""
    return Camera([60.0, 66.0], [39.5, 30.25], 80, 64)


def world(i, camera):
    return sc.moved_points(sc.path_pose(i), sc.observe_room(sc.path_pose(i), camera))


def coarse_of(prediction, camera, config, previous=None, estimate=CERTAIN):
    previous = world(FRAME - 1, camera) if previous is None else previous
    return coarse_step(prediction, previous, sc.path_pose(FRAME - 1), camera, config, estimate)


def with_views(prediction, change):
    """The prediction with each of its poses changed."""
    views = map(jaxlie.SE3, np.asarray(prediction.T_world_views.wxyz_xyz))
    return eqx.tree_at(lambda p: p.T_world_views, prediction, sc.stack_poses([change(T) for T in views]))


def shifted(prediction, motion):
    """The same prediction, placed elsewhere."""
    return with_views(prediction, lambda T: sc.product(motion, T))


@pytest.fixture(scope="module")
def printed(config):
    """Scale `none` and memory 1, whatever the presets say."""
    return sc.at(config("slam.localization.coarse_scale=none").localization, "scale_std", np.inf)


def limit_of(reading: str, otherwise: float) -> float:
    """Closest points are up to half a pixel apart (1.5 cm on the walls), on average to all sides."""
    return 0.012 if reading == "via_previous" else otherwise


@pytest.mark.parametrize("reading", COARSE)
def test_an_exact_chain_is_recovered_exactly(wide, printed, reading):
    result = coarse_of(sc.predict_room(FRAME, wide), wide, sc.at(printed, "coarse", COARSE[reading]))
    # Quaternions from float32 matrices: 5e-4 rad at worst, and as much per metre.
    limit = limit_of(reading, 1e-3)
    assert max(sc.pose_error(result.T_world_camera, sc.path_pose(FRAME))) < limit
    assert max(sc.pose_error(result.T_world_newest, sc.path_pose(FRAME + 1))) < limit + 1e-3
    assert result.scale == 1 and result.repeat_rms < 1e-5 and result.is_usable
    depths = np.asarray(sc.observe_room(sc.path_pose(FRAME - 1), wide).points)[:, 2]
    assert result.mean_depth == pytest.approx(np.median(depths), rel=0.01)


@pytest.mark.parametrize("reading", COARSE)
@pytest.mark.parametrize("kind", ["ratio", "estimated"])
def test_a_known_scale_is_found_and_the_chain_with_it(wide, printed, kind, reading):
    config = sc.at(sc.at(printed, "coarse_scale", SCALES[kind]), "coarse", COARSE[reading])
    result = coarse_of(sc.predict_room(FRAME, wide, scale=0.9), wide, config)
    np.testing.assert_allclose(result.scale, 1 / 0.9, rtol=1e-4)  # float32 sums
    distance, angle = sc.pose_error(result.T_world_camera, sc.path_pose(FRAME))
    limit = limit_of(reading, 2e-3)
    assert distance < limit and angle < limit
    # The newest image comes from the same call, so the way to it has the same scale.
    distance, angle = sc.pose_error(result.T_world_newest, sc.path_pose(FRAME + 1))
    assert distance < limit + 1e-3 and angle < limit
    assert result.repeat_rms < 1e-3  # what the scale explains is no disagreement; 10 % of 2 m are not 1 mm


def test_a_ratio_is_not_moved_by_wrong_depths_and_a_fit_is(wide, printed):
    """A fifth of the previous image was seen half as far again: the median does not mind, least squares do."""
    previous, is_bad = world(FRAME - 1, wide), np.arange(80 * 64)[:, None] % 5 == 0
    from_camera = previous.points - np.asarray(sc.path_pose(FRAME - 1).translation())
    bad = sc.replace(previous, points=previous.points + np.where(is_bad, 0.5 * from_camera, 0.0))
    ratio, fit = (
        coarse_of(
            sc.predict_room(FRAME, wide, scale=0.9), wide, sc.at(printed, "coarse_scale", SCALES[kind]), bad
        ).scale
        for kind in ("ratio", "estimated")
    )
    assert abs(ratio - 1 / 0.9) < 0.001 < 0.01 < abs(fit - 1 / 0.9)


def test_the_printed_form_estimates_no_scale_and_the_priors_own_unit_holds_it(wide, printed):
    """log s = P γ / (P + s_p²) + s_p² log r / (P + s_p²) for the ratio r, known to P, and the prior's own unit e^γ."""
    prediction, T = sc.predict_room(FRAME, wide, scale=0.9), sc.path_pose(FRAME - 1)
    assert coarse_of(prediction, wide, printed).scale == 1
    ratio = sc.changed(printed, **{"coarse_scale": SCALES["ratio"], "icp.scale_noise": 0.5})
    estimate = sc.replace(CERTAIN, log_scale=0.02)
    noise = 0.3 * np.random.default_rng(0).normal(size=(wide.height * wide.width, 1))
    before = sc.observe_room(T, wide)
    before = sc.moved_points(T, sc.replace(before, points=before.points * np.exp(noise)))
    found, known = sc.on_host(repeat_scale)(prediction.previous, before, T, sc.device(1.0), ratio.coarse_scale)
    for std in (0.02, 0.1):
        result = coarse_of(prediction, wide, sc.at(ratio, "scale_std", std), before, estimate)
        expected = (known**2 * 0.02 + std**2 * np.log(found)) / (known**2 + std**2)
        np.testing.assert_allclose(np.log(result.scale), expected, atol=1e-4)
        np.testing.assert_allclose(result.estimate.covariance[6, 6], 1 / (known**-2 + std**-2), rtol=1e-3)
    held = coarse_of(prediction, wide, sc.at(ratio, "icp.scale_noise", 0.0), before, estimate)
    assert held.estimate.covariance[6, 6] < 1e-10


def test_without_a_pair_the_scale_is_the_priors_own_unit(wide, printed):
    prediction = sc.predict_room(FRAME, wide, scale=0.9)
    blind = eqx.tree_at(lambda p: p.previous.valid, prediction, sc.device(np.zeros(80 * 64, bool)))
    ratio = sc.at(printed, "coarse_scale", SCALES["ratio"])
    found = coarse_of(blind, wide, ratio, estimate=sc.replace(CERTAIN, log_scale=-0.2))
    np.testing.assert_allclose(found.scale, np.exp(-0.2), rtol=1e-5)


def test_the_printed_coarse_pose_does_not_use_the_priors_absolute_pose(wide, printed):
    """What the chain throws away: the same prediction placed elsewhere gives the same chain."""
    prediction, shift = sc.predict_room(FRAME, wide), sc.pose((0.05, 0.02, -0.03), (0.2, -0.1, 0.3))
    elsewhere = shifted(prediction, shift)
    for reading in ("same_image", "via_previous"):
        config = sc.at(printed, "coarse", COARSE[reading])
        one, other = (coarse_of(p, wide, config).T_world_camera for p in (prediction, elsewhere))
        assert max(sc.pose_error(other, one)) < 2e-3  # as for the exact chain
    anchored = coarse_of(elsewhere, wide, sc.at(printed, "coarse", COARSE["anchored"])).T_world_camera
    assert max(sc.pose_error(anchored, sc.product(shift, sc.path_pose(FRAME)))) < 1e-3


def repeats_of(motion: float, own: float):
    """A great many that say these deviations, where three quarters of the variance are shared."""
    log_squares = np.array([[2 * np.log(std) + np.log(0.5) - 0.36898] * 2 for std in (motion, own)])
    return sc.replace(no_repeats(), log_squares=log_squares, counts=np.full(2, 1e6))


@pytest.mark.parametrize("ratio", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("shifted_by", [0.005, 0.1])
def test_the_fused_pose_weighs_chain_and_anchor_by_their_variances(wide, printed, ratio, shifted_by):
    """By the variances of the prior's motion and of its own pose, and that one's Cauchy weight."""
    elsewhere = shifted(sc.predict_room(FRAME, wide), sc.pose(translation=(shifted_by, 0, 0)))
    config = sc.changed(printed, coarse=COARSE["fused"], pose_shared=0.75, num_shared=1e7)
    config = sc.at(config, "icp.prior_information", 30.0)
    estimate = eqx.tree_at(lambda b: b.repeats, CERTAIN, repeats_of(0.005, 0.005 * ratio))
    result = coarse_of(elsewhere, wide, config, estimate=estimate)
    motion = (0.005 * float(result.mean_depth)) ** 2
    own = motion * ratio**2
    weighted = own * (1 + shifted_by**2 / (motion + own) / 6)
    share = motion / (motion + weighted)
    moved = sc.pose_error(result.T_world_camera, sc.path_pose(FRAME))[0]
    assert moved == pytest.approx(shifted_by * share, abs=1e-3)  # as above
    np.testing.assert_allclose(
        np.diag(result.estimate.covariance)[:3], motion * weighted / (motion + weighted), rtol=0.05
    )


def given(prediction, motion: float, own: float):
    """The prediction of a prior that knows its motion and its own pose to so many metres and radians."""
    covariance = np.stack([std**2 * np.eye(6) for std in (motion, own)])
    return eqx.tree_at(lambda p: p.pose_covariance, prediction, sc.device(covariance))


def test_poses_that_are_given_are_weighed_as_the_prior_says_and_not_by_what_differs(wide, printed):
    """Motion and own pose differ by 5 mm: the variances are the given ones, whatever was predicted twice before."""
    shifted_by, motion, own = 0.005, 0.02, 0.01
    elsewhere = given(shifted(sc.predict_room(FRAME, wide), sc.pose(translation=(shifted_by, 0, 0))), motion, own)
    config = sc.changed(printed, coarse=COARSE["fused"], pose_shared=0.75, **{"icp.prior_information": 0.5})  # any
    estimate = eqx.tree_at(lambda b: b.repeats, CERTAIN, repeats_of(1e-3, 0.3))
    result = coarse_of(elsewhere, wide, config, estimate=estimate)
    weighted = own**2 * (1 + shifted_by**2 / (motion**2 + own**2) / 6)  # Cauchy
    moved = sc.pose_error(result.T_world_camera, sc.path_pose(FRAME))[0]
    assert moved == pytest.approx(shifted_by * motion**2 / (motion**2 + weighted), abs=3e-4)  # roundings of float32
    expected = motion**2 * weighted / (motion**2 + weighted)
    np.testing.assert_allclose(np.diag(result.estimate.covariance)[:6], expected, rtol=0.02)
    assert result.estimate.is_given and not np.any(result.estimate.repeats.counts)


def test_the_scale_of_the_depths_moves_no_pose_that_is_given(wide, printed):
    """Depths 10 % too small, poses right: the scale is that of the depths, the pose that of the prior."""
    right, small = sc.predict_room(FRAME, wide), sc.predict_room(FRAME, wide, scale=0.9)
    mixed = eqx.tree_at(lambda p: p.T_world_views, small, right.T_world_views)
    known = {"coarse": COARSE["fused"], "coarse_scale": SCALES["ratio"], "icp.prior_information": 30.0}
    config = sc.changed(printed, **known)
    result = coarse_of(given(mixed, 1e-3, 1e-3), wide, config)
    np.testing.assert_allclose(result.scale, 1 / 0.9, rtol=1e-3)
    for T, expected in ((result.T_world_camera, FRAME), (result.T_world_newest, FRAME + 1)):
        assert max(sc.pose_error(T, sc.path_pose(expected))) < 1e-3
    # Of poses that are not given the scale is one with that of the depths.
    assert sc.pose_error(coarse_of(mixed, wide, config).T_world_camera, sc.path_pose(FRAME))[0] > 3e-3


@pytest.mark.parametrize("std", [0.0, 0.03, np.nan])
def test_the_scale_of_depths_is_as_sure_as_the_prior_says(wide, printed, std):
    """Depths 10 % too small beside a map whose scale is known to 10 %: as in a Kalman filter."""
    right, small = sc.predict_room(FRAME, wide), sc.predict_room(FRAME, wide, scale=0.9)
    mixed = eqx.tree_at(lambda p: (p.T_world_views, p.scale_std), small, (right.T_world_views, sc.device(std)))
    known = {"coarse": COARSE["fused"], "coarse_scale": SCALES["ratio"], "icp.prior_information": 30.0}
    config = sc.changed(printed, scale_std=np.inf, **known)
    before = eqx.tree_at(lambda b: b.covariance, CERTAIN, sc.device(np.diag([0.0] * 6 + [0.1**2])))
    found = np.log(coarse_of(given(mixed, 1e-3, 1e-3), wide, config, estimate=before).scale)
    expected = 0.0 if np.isnan(std) else 0.1**2 / (0.1**2 + max(std, 2e-4) ** 2)
    assert found == pytest.approx(-np.log(0.9) * (1 - expected), abs=2e-3)
    # Of poses that are not known nothing ties the depths to them.
    assert coarse_of(mixed, wide, config, estimate=before).scale == pytest.approx(1 / 0.9, rel=2e-3)


def test_points_that_are_too_far_apart_are_no_pair(wide, printed):
    """Three in five points of the previous image are half a metre off in both of its predictions, so they agree.

    The current points there do not, and with such pairs the pose would follow the majority.
    """
    is_bad = (np.arange(80 * 64) % 5 > 1)[:, None]
    prediction = sc.predict_room(FRAME, wide)
    now = sc.replace(prediction.previous, points=prediction.previous.points + np.where(is_bad, [0.5, 0, 0], 0.0))
    prediction = eqx.tree_at(lambda p: p.previous, prediction, now)
    previous = sc.moved_points(sc.path_pose(FRAME - 1), now)
    result = coarse_of(prediction, wide, sc.at(printed, "coarse", COARSE["via_previous"]), previous)
    distance, angle = sc.pose_error(result.T_world_camera, sc.path_pose(FRAME))
    assert distance < 0.02 and angle < 0.01  # half a pixel, of fewer pairs


def test_pairs_that_are_farther_apart_than_allowed_are_none(wide, printed):
    """Without a pair the prior's own motion, which is 3 cm off, stands in."""
    given, off = sc.predict_room(FRAME, wide), sc.pose(translation=(0.03, 0.0, 0.0))
    views = [jaxlie.SE3(values) for values in np.asarray(given.T_world_views.wxyz_xyz)]
    moved = sc.product(views[1], off)
    given = eqx.tree_at(lambda p: p.T_world_views, given, sc.stack_poses([views[0], moved, views[2]]))
    config = sc.at(printed, "coarse", COARSE["via_previous"])
    near, none = (coarse_of(given, wide, sc.at(config, "max_pair_distance", most)) for most in (0.05, 0.0))
    assert sc.pose_error(none.T_world_camera, moved)[0] < 1e-5
    assert sc.pose_error(near.T_world_camera, moved)[0] > 1e-3


def test_a_pose_of_which_a_part_is_no_number_is_none(wide, printed):
    given = sc.predict_room(FRAME, wide)
    views = np.array(given.T_world_views.wxyz_xyz)
    views[1, 4:] = np.nan
    given = eqx.tree_at(lambda p: p.T_world_views, given, jaxlie.SE3(sc.device(views)))
    found = coarse_of(given, wide, sc.at(printed, "coarse", COARSE["anchored"]))
    assert not found.is_usable and max(sc.pose_error(found.T_world_camera, sc.path_pose(FRAME - 1))) < 1e-6


def test_where_nothing_leads_from_the_frame_before_a_pose_is_as_uncertain_as_a_fine_step_may_go(wide, printed):
    given = sc.predict_room(FRAME, wide)
    before = sc.moved_points(sc.path_pose(FRAME - 1), given.previous)
    before = sc.replace(before, valid=np.zeros(80 * 64, bool))
    found = coarse_of(given, wide, sc.at(printed, "coarse", COARSE["anchored"]), before)
    steps = [float(printed.max_step) * found.mean_depth] * 3 + [float(printed.max_step_rad)] * 3
    np.testing.assert_allclose(np.sqrt(np.diag(found.estimate.covariance))[:6], steps, rtol=1e-3)


@pytest.mark.parametrize("count", [15, 16])
def test_a_frame_is_usable_from_sixteen_points_on(wide, printed, count):
    prediction = sc.predict_room(FRAME, wide)
    few = eqx.tree_at(lambda p: p.current.valid, prediction, sc.device(np.arange(80 * 64) < count))
    assert coarse_of(few, wide, printed).is_usable == (count == 16)


@pytest.mark.parametrize("factor", [1 / 64, 8.0, 64.0])
def test_a_scale_is_found_however_large_or_small(wide, printed, factor):
    """No unit is special: of a prediction in another one the depths say by what it is to be multiplied."""
    for kind in ("ratio", "estimated"):
        config = sc.at(printed, "coarse_scale", SCALES[kind])
        result = coarse_of(sc.predict_room(FRAME, wide, scale=factor), wide, config)
        np.testing.assert_allclose(result.scale, 1 / factor, rtol=1e-4)


def test_a_newest_pose_that_is_no_number_is_the_current_one(wide, printed):
    prediction = sc.predict_room(FRAME, wide)
    poses = np.array(prediction.T_world_views.wxyz_xyz)
    poses[2] = np.nan
    lost = eqx.tree_at(lambda p: p.T_world_views, prediction, jaxlie.SE3(sc.device(poses)))
    result = coarse_of(lost, wide, printed)
    assert result.is_usable
    sc.assert_same(result.T_world_newest, result.T_world_camera)


def test_repeat_rms_is_the_standard_deviation_between_the_two_predictions(wide, printed):
    noise = np.random.default_rng(0).normal(size=(80 * 64, 3)) * [0.03, 0, 0]
    previous = world(FRAME - 1, wide)
    noisy = sc.replace(previous, points=previous.points + noise)
    result = coarse_of(sc.predict_room(FRAME, wide), wide, printed, noisy)
    assert result.repeat_rms == pytest.approx(0.03, rel=0.05)  # the median of 5,000 samples


@pytest.mark.parametrize("reading", COARSE)
def test_the_newest_image_has_the_current_pose_where_there_is_none(wide, printed, reading):
    result = coarse_of(sc.predict_room(FRAME, wide, has_newest=False), wide, sc.at(printed, "coarse", COARSE[reading]))
    sc.assert_same(result.T_world_newest, result.T_world_camera)


@pytest.mark.parametrize("reading", COARSE)
def test_outliers_among_the_pairs_do_not_move_the_pose(wide, printed, reading):
    previous = world(FRAME - 1, wide)
    bad = sc.replace(previous, points=previous.points + np.where(np.arange(80 * 64)[:, None] % 7 == 0, 0.5, 0.0))
    result = coarse_of(sc.predict_room(FRAME, wide), wide, sc.at(printed, "coarse", COARSE[reading]), bad)
    assert sc.pose_error(result.T_world_camera, sc.path_pose(FRAME))[0] < 0.02


@pytest.mark.parametrize("count", [0, 15, 16])
def test_without_enough_pairs_the_priors_own_pose_stands_in_for_the_chain(wide, printed, count):
    """Sixteen pairs make a chain, for the printed reading, too: the pose before it may be one that only stands in."""
    shift, seen = sc.pose(translation=(0.2, -0.1, 0.3)), np.arange(80 * 64) % 300 == 7
    seen &= np.cumsum(seen) <= count
    blind = eqx.tree_at(lambda p: p.previous.valid, shifted(sc.predict_room(FRAME, wide), shift), sc.device(seen))
    result = coarse_of(blind, wide, sc.at(printed, "coarse", COARSE["same_image"]))
    expected = sc.path_pose(FRAME) if count >= 16 else sc.product(shift, sc.path_pose(FRAME))
    assert max(sc.pose_error(result.T_world_camera, expected)) < 2e-3
    printed_result = coarse_of(blind, wide, sc.at(printed, "coarse", COARSE["via_previous"]))
    assert max(sc.pose_error(printed_result.T_world_camera, expected)) < (2e-3 if count < 16 else 0.1)
    # Where the chain is broken the pose is worth what the prior's own is; where it is not, what both are.
    fused = sc.changed(printed, **{"coarse": COARSE["fused"], "icp.prior_information": 30.0})
    known, apart = (coarse_of(p, wide, fused) for p in (sc.predict_room(FRAME, wide), blind))
    assert max(sc.pose_error(apart.T_world_camera, expected)) < (2e-3 if count < 16 else 0.5)
    if count < 16:
        noise = own = float(apart.depth_noise * apart.mean_depth) / 30**0.5  # nothing is said twice yet
        far = min(float(fused.max_step), 1.0) * float(apart.mean_depth)
        together = 1 / np.sqrt(1 / own**2 + 1 / (far**2 + noise**2))
        np.testing.assert_allclose(np.sqrt(np.diag(apart.estimate.covariance)[:3]), together, rtol=0.1)
        assert np.all(np.diag(apart.estimate.covariance)[:3] > np.diag(known.estimate.covariance)[:3])
    if count == 0:  # nothing is known, and the largest distance of a pair stands in
        unknown = float(printed.max_pair_distance * result.mean_depth)
        assert result.repeat_rms == pytest.approx(1.4826 * unknown, rel=1e-5)
    assert np.isfinite(result.mean_depth)


# The fine step, at the small size.


@pytest.fixture(scope="module")
def submap(camera, config):
    """Gaussians of the room from two views, so that all of the frame is mapped."""
    points = sc.join(world(1, camera), world(FRAME + 1, camera))
    return sc.on_host(fit_to_points)(np.asarray(points.points)[::8], np.ones(192, bool), points, config().fit)


@pytest.fixture(scope="module")
def lenient(config):
    """Coarse as the prior says, fine as printed but with wide gates; every check passes."""
    settings = config("slam.localization.coarse_scale=none", "slam.localization.icp.residual=colored").localization
    gates = {"min_inlier_fraction": 0.0, "icp.prior_information": 0.0}
    gates |= dict.fromkeys(("max_residual", "max_step", "max_step_rad", "max_pose_std"), np.inf)
    gates |= {"icp.max_mahalanobis_sq": 25.0}
    return sc.changed(settings, coarse=COARSE["anchored"], **gates)


def fine_of(prediction, submap, camera, config):
    coarse = coarse_of(prediction, camera, config)
    return coarse, *fine_step(prediction.current, submap, coarse, config)


def nudged(camera):
    """A prediction whose own poses are 3 cm and 1 degree off."""
    wrong = sc.pose((0.01, -0.015, 0.0), (0.02, 0.01, -0.02))
    return with_views(sc.predict_room(FRAME, camera), lambda T: sc.product(T, wrong))


def test_a_tracked_frame_is_nearer_to_the_truth_and_its_points_are_in_the_world(camera, submap, lenient):
    coarse, T, aligned, info = fine_of(nudged(camera), submap, camera, lenient)
    before, after = (sc.pose_error(x, sc.path_pose(FRAME)) for x in (coarse.T_world_camera, T))
    assert info.is_tracked and not info.is_lost and info.reason == 0
    assert after[0] < 0.6 * before[0], (before, after)
    moved = sc.moved_points(T, sc.predict_room(FRAME, camera).current, info.scale)
    np.testing.assert_allclose(aligned.points, moved.points, atol=1e-5)  # roundings
    step = sc.pose_error(T, coarse.T_world_camera)
    np.testing.assert_allclose([info.step_m, info.step_rad], step, atol=1e-4)


def test_depths_that_repeat_exactly_do_not_hold_a_wrong_pose(camera, submap, lenient):
    """A prior that keeps the depth of an image repeats it to the bit, which says nothing of the pose between two."""
    settings = sc.at(lenient, "icp.prior_information", 3.0)  # the sparse Gaussians of this room are centimetres thick
    coarse = coarse_of(nudged(camera), camera, settings)
    assert coarse.depth_noise < 1e-3
    T, _, info = fine_step(nudged(camera).current, submap, coarse, settings)
    assert info.is_tracked
    assert sc.pose_error(T, sc.path_pose(FRAME))[0] < 0.8 * sc.pose_error(coarse.T_world_camera, sc.path_pose(FRAME))[0]
    held, _, _ = fine_step(nudged(camera).current, submap, coarse, sc.at(settings, "icp.max_misfit", 0.0))
    assert sc.pose_error(held, coarse.T_world_camera)[0] < 0.03 * 0.1


def small_prediction(camera):
    """A prediction that is 4 % too small, which no coarse scale mends."""
    return sc.predict_room(FRAME, camera, scale=0.96)


@pytest.mark.parametrize(("depth_noise", "coarse_scale"), [(0.01, 1.0), (0.03, 1.1), (1e-3, 1.0)])
def test_the_fine_step_is_icp_of_the_scaled_points_with_the_noise_of_the_coarse_pose(
    camera, submap, lenient, depth_noise, coarse_scale
):
    """The noise of the points' depth, and what is known of the pose."""
    settings = sc.changed(lenient, **{"icp.prior_information": 30.0, "icp.scale_noise": 1.0})
    coarse = coarse_of(nudged(camera), camera, settings)
    coarse = sc.replace(coarse, depth_noise=np.float32(depth_noise), scale=np.float32(coarse_scale))
    current = small_prediction(camera).current
    T, aligned, info = fine_step(current, submap, coarse, settings)
    scaled = sc.replace(current, points=coarse_scale * np.asarray(current.points))
    known = sc.device(sc.on_host(root_information)(coarse.estimate.covariance))
    expected, scale, found = solve(
        scaled,
        submap,
        CoarseStart(coarse.T_world_camera, known, sc.device(depth_noise), sc.device(False)),
        settings.icp,
    )
    # Another program rounds in another order; the solver stops within its tolerance.
    assert max(sc.pose_error(T, expected)) < 1e-4
    np.testing.assert_allclose(info.scale, coarse_scale * scale, rtol=1e-4)
    np.testing.assert_allclose(info.depth_noise, found.misfit, rtol=1e-2)
    np.testing.assert_allclose(info.noise, np.full(info.noise.shape, found.misfit), rtol=1e-2)  # equal confidences
    f = sc.on_host(field_at)(info.icp.field, current.points)
    assert 0.01 < np.abs(f).max() < 0.2, "prediction and map differ by 4 %, and more at corners of a coarse map"
    without = sc.replace(current, points=np.asarray(current.points) * np.exp(-f)[:, None])
    np.testing.assert_allclose(aligned.points, sc.moved_points(T, without, info.scale).points, atol=1e-5)
    assert info.is_tracked and info.repeat_rms == coarse.repeat_rms


@pytest.mark.parametrize(("scale_std", "has_field"), [(0.0, False), (1e-3, True), (np.nan, True)])
def test_depths_that_are_triangulated_have_no_field(camera, submap, lenient, scale_std, has_field):
    settings = sc.changed(lenient, **{"icp.prior_information": 30.0})
    sure = {"pose_covariance": np.tile(1e-6 * np.eye(6), (2, 1, 1)), "scale_std": np.float32(scale_std)}
    current = nudged(camera).current
    points = np.asarray(current.points)
    current = sc.replace(current, points=points * np.exp(0.2 * points[:, :1] / points[:, 2:]))
    prediction = eqx.tree_at(lambda p: p.current, sc.replace(nudged(camera), **sure), current)
    coarse, T, aligned, info = fine_of(prediction, submap, camera, settings)
    assert coarse.has_field == has_field == bool(np.abs(info.icp.field.nodes).max() > 1e-3)
    if not has_field:
        moved = sc.moved_points(T, current, info.scale).points
        np.testing.assert_allclose(aligned.points, moved, atol=1e-5)


@pytest.mark.parametrize(
    ("pose_std", "scale_std", "is_placed"),
    [(1e-3, 1e-3, True), (1e-3, np.nan, True), (1e-3, 0.0, False), (1.0, 1e-3, False), (np.nan, np.nan, False)],
)
def test_a_pose_that_is_known_without_the_points_is_not_doubted_for_them(
    camera, submap, lenient, pose_std, scale_std, is_placed
):
    """Depths of a network beside a map that they differ from: their error, where the pose is given and sure."""
    settings = sc.changed(lenient, **{"icp.prior_information": 30.0, "max_residual": 0.0})
    known = {"pose_covariance": np.tile(pose_std**2 * np.eye(6), (2, 1, 1)), "scale_std": np.float32(scale_std)}
    before = sc.replace(CERTAIN, depth_noise=np.float32(0.05))  # of the frame before beside the map
    prediction = sc.replace(nudged(camera), **known)
    coarse = coarse_of(prediction, camera, settings, estimate=before)
    _, _, info = fine_step(prediction.current, submap, coarse, settings)
    assert coarse.is_placed == info.is_tracked == is_placed
    assert int(info.reason) == (0 if is_placed else 4) and info.icp.residual > 0


def test_a_scale_that_is_accepted_is_that_of_the_points_and_one_that_is_not_is_dropped(camera, submap, lenient):
    settings = sc.changed(lenient, **{"icp.prior_information": 30.0, "icp.scale_noise": 10.0})
    prediction = small_prediction(camera)
    _, T, aligned, info = fine_of(prediction, submap, camera, settings)
    assert info.is_tracked
    assert info.scale == pytest.approx(1 / 0.96, abs=0.015)  # points meet centres of sparse Gaussians
    np.testing.assert_allclose(aligned.points, sc.moved_points(T, prediction.current, info.scale).points, atol=1e-5)
    _, T, aligned, info = fine_of(prediction, submap, camera, sc.at(settings, "max_step", 0.0))
    assert not info.is_tracked and info.scale == 1
    np.testing.assert_allclose(aligned.points, sc.moved_points(T, prediction.current).points, atol=1e-5)


@pytest.mark.parametrize(
    ("bit", "field", "value"),
    [
        (1, "min_inlier_fraction", 1.01),
        (2, "max_residual", 0.0),
        (3, "max_step", 1e-6),
        (3, "max_step_rad", 1e-6),
        (4, "max_pose_std", 1e-9),
    ],
)
def test_each_check_alone_keeps_the_coarse_pose_and_says_why(camera, submap, lenient, bit, field, value):
    coarse, T, aligned, info = fine_of(nudged(camera), submap, camera, sc.at(lenient, field, value))
    assert not info.is_tracked and not info.is_lost
    assert int(info.reason) == 2**bit and bit < len(REASONS)
    sc.assert_same(T, coarse.T_world_camera)
    assert aligned.valid.all()  # the next frame's coarse step still needs them


def test_a_step_may_be_as_long_as_a_share_of_the_mean_depth(camera, submap, lenient):
    coarse, _, _, info = fine_of(nudged(camera), submap, camera, lenient)
    share = float(info.step_m / coarse.mean_depth)
    assert abs(coarse.mean_depth - 1) > 0.1  # or a metre would do
    for allowed in (0.99, 1.01):
        _, _, limited = fine_step(nudged(camera).current, submap, coarse, sc.at(lenient, "max_step", allowed * share))
        assert limited.is_tracked == (allowed > 1)


@pytest.mark.parametrize("residual", [0, 1, 2])
def test_a_single_untextured_wall_does_not_determine_the_pose(camera, submap, lenient, config, residual):
    """With the configured limit; the room's other walls and all colour are taken away."""
    wall = submap.normals[:, 2] < -0.99
    plain = sc.replace(submap, valid=wall, colors=np.full((192, 3), 0.5), normals=np.tile([0.0, 0, -1], (192, 1)))
    grey = eqx.tree_at(lambda p: p.current.colors, sc.predict_room(FRAME, camera), sc.device(np.full((768, 3), 0.5)))
    settings = sc.changed(lenient, **{"max_pose_std": config().localization.max_pose_std, "icp.residual": residual})
    coarse, T, _, info = fine_of(grey, plain, camera, settings)
    assert int(info.reason) & 16 and not info.is_tracked
    sc.assert_same(T, coarse.T_world_camera)


def test_a_wall_before_a_camera_whose_pose_is_given_is_enough(camera, submap, lenient, config):
    """What determines the pose is what was known of it before and the points, together."""
    wall = submap.normals[:, 2] < -0.99
    plain = sc.replace(submap, valid=wall, colors=np.full((192, 3), 0.5), normals=np.tile([0.0, 0, -1], (192, 1)))
    limit = {"max_pose_std": config().localization.max_pose_std, "icp.prior_information": 30.0}
    settings = sc.changed(lenient, coarse=COARSE["fused"], **limit)
    for std, is_tracked in ((0.01, True), (1.0, False)):
        prediction = given(sc.predict_room(FRAME, camera), std, std)
        prediction = eqx.tree_at(lambda p: p.current.colors, prediction, sc.device(np.full((768, 3), 0.5)))
        *_, info = fine_of(prediction, plain, camera, settings)
        assert info.is_tracked == is_tracked and int(info.reason) == (0 if is_tracked else 16)


def test_a_pose_that_is_given_stays_where_the_points_do_not_fit(camera, submap, lenient):
    """A millimetre, and points that are 4 % too small, which no scale may mend."""
    settings = sc.changed(lenient, coarse=COARSE["fused"], **{"icp.prior_information": 30.0})
    right = sc.predict_room(FRAME, camera)
    small = eqx.tree_at(lambda p: p.T_world_views, small_prediction(camera), right.T_world_views)
    moved = []
    for prediction in (given(small, 1e-3, 1e-3), small):
        _, T, _, info = fine_of(prediction, submap, camera, settings)
        moved.append(sc.pose_error(T, sc.path_pose(FRAME))[0])
        assert info.is_tracked
    assert moved[0] < 2e-3 < 5e-3 < moved[1]


def test_the_printed_form_knows_nothing_before_whatever_the_prior_says(camera, submap, config):
    settings, prediction = config("slam/localization=paper").localization, nudged(camera)
    unknown, known = (fine_of(p, submap, camera, settings) for p in (prediction, given(prediction, 1e-3, 1e-3)))
    sc.assert_same(known[0].T_world_camera, unknown[0].T_world_camera)
    sc.assert_same(known[1:3], unknown[1:3])
    sc.assert_same(known[3].icp, unknown[3].icp)


@pytest.mark.parametrize("loss", ["no point", "nan pose"])
def test_nothing_is_valid_without_points_or_pose_and_a_frame_without_pose_is_lost(camera, submap, lenient, loss):
    prediction = sc.predict_room(FRAME, camera)
    if loss == "no point":
        prediction = eqx.tree_at(lambda p: p.current.valid, prediction, sc.device(np.zeros(768, bool)))
    else:
        nowhere = jaxlie.SE3(sc.device(np.full((3, 7), np.nan)))
        prediction = eqx.tree_at(lambda p: p.T_world_views, prediction, nowhere)
    coarse, T, aligned, info = fine_of(prediction, submap, camera, lenient)
    assert info.is_lost == (loss == "nan pose") and not info.is_tracked and int(info.reason) & 1
    assert not aligned.valid.any()
    for x in jax.tree.leaves((T, aligned, coarse.T_world_newest)):
        assert np.isfinite(x).all()
    sc.assert_same(T, sc.path_pose(FRAME - 1) if info.is_lost else coarse.T_world_camera)
    if loss == "no point":
        np.testing.assert_allclose(T.wxyz_xyz, sc.path_pose(FRAME).wxyz_xyz, atol=1e-4)  # the prior is exact

"""Merging on the image plane: the formulas of eq. 5 and 6 for one Gaussian, each reason to be fresh, nothing lost."""

import numpy as np
import pytest
import reference
import scene as sc
from scipy.spatial import cKDTree

from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.gaussians import Gaussians
from emgs_jax.ops.camera import Camera
from emgs_jax.refinement import match_on_image, refine, without_scattered
from emgs_jax.render.project import Splats

refined, matched = map(sc.on_host, (refine, match_on_image))
CAMERA_POSE = sc.pose()
NUM_MAP, NUM_NEW = 104, 40  # rows of every map and of all candidates, most of which are free: one program for all


def discs(means, std=0.15, feature=(1.0, 0.0), color=0.5) -> Gaussians:
    """Discs that face the camera."""
    return sc.flat_gaussians(means, std, color=color, features=feature)


def filled(gaussians: Gaussians, count: int) -> Gaussians:
    """With free rows after them, which hold wild values."""
    rows = np.arange(count)
    is_given = rows < gaussians.valid.shape[0]
    more = sc.rows_of(gaussians, np.where(is_given, rows, 0))
    return sc.replace(sc.poisoned(more, is_given, 7.0), valid=more.valid & is_given)


GRID = [(x, y, 2.0) for x in np.arange(-0.6, 0.61, 0.3) for y in np.arange(-0.6, 0.61, 0.3)]


@pytest.fixture(scope="module")
def settings(config):
    """As printed (margins 0 and infinite, linear blend, α/(α+…)), but 1 cm of margin for rounding."""
    return sc.at(config("slam/em=paper", "slam/fit=paper", "slam/refinement=paper").refinement, "front_margin", 0.005)


def run(settings, camera, candidates, gaussians=None, weight=1.0, T=CAMERA_POSE):
    """The given rows of the map and of what is fresh, and counts."""
    gaussians = discs(GRID) if gaussians is None else gaussians
    held, new = gaussians.valid.shape[0], candidates.valid.shape[0]
    map = sc.fresh_map(filled(gaussians, NUM_MAP), np.resize(weight, NUM_MAP))
    merged, fresh, info = refined(map, filled(candidates, NUM_NEW), T, camera, settings)
    return sc.rows_of(merged, slice(held)), sc.rows_of(fresh, slice(new)), info


def map_of(gaussians: Gaussians) -> GaussianMap:
    """As it was given."""
    return sc.rows_of(sc.fresh_map(gaussians), slice(None))


def test_evidence_of_a_merged_candidate_is_shared_out_and_none_is_lost(settings, camera):
    """Two equal map Gaussians: each gets half of the candidate's evidence; what is not merged gives none."""
    old = discs([(0.02, 0, 2.0), (-0.02, 0, 2.0)], std=0.3)
    new = discs([(0, 0, 2.0), (0, 0, 1.0)], std=0.3, feature=(3.0, 1.0))
    merged, fresh, info = run(sc.at(settings, "feature", 1.0), camera, new, old)
    assert info.num_merged == 1 and fresh.valid.tolist() == [False, True]
    np.testing.assert_allclose(merged.gaussians.features, np.tile([1.0 + 1.5, 0.5], (2, 1)), rtol=1e-4)


@pytest.mark.parametrize(
    ("mean", "why"),
    [
        ((0.02, 0.0, 1.5), "in front of the surface"),
        ((0.02, 0.0, 1.97), "in front by more than the margin"),
        ((1.15, 0.9, 2.0), "on pixels without map depth"),
        ((0.0, 0.0, -1.0), "behind the camera"),
        ((30.0, 0.0, 2.0), "outside the image"),
    ],
)
def test_a_candidate_that_is_not_on_the_surface_is_fresh_and_the_map_unchanged(settings, camera, mean, why):
    merged, fresh, info = run(settings, camera, discs(mean, std=0.05))
    assert (info.num_merged, info.num_fresh) == (0, 1) and fresh.valid.all(), why
    sc.assert_same(merged, map_of(discs(GRID)))


READINGS = {
    "printed": {"back_margin": np.inf, "max_mahalanobis_sq_2d": 4.6, "average.gain": 0.0},
    "default": {"back_margin": 0.1, "front_margin": 0.1, "average.gain": 1.0},
    "pairs": {"depth_condition": 1.0, "back_margin": 0.1, "front_margin": 0.05, "min_normal_cos": 0.9},
    "narrow": {"max_mahalanobis_sq_2d": 1.0, "back_margin": 0.1, "front_margin": 0.05, "average.forgetting": 0.7},
}


@pytest.mark.parametrize("reading", READINGS)
def test_a_refinement_equals_equations_5_and_6_one_candidate_at_a_time(settings, camera, reading):
    """A wall of discs of many sizes, features and weights, one before and one behind it, and candidates all around."""
    rng, count = np.random.default_rng(3), 27
    config = sc.changed(settings, **READINGS[reading])
    means = np.array([*GRID, (0.1, 0.1, 1.4), (0.02, 0.02, 3.0)]) + rng.uniform(-0.05, 0.05, (count, 3))
    turns = rng.uniform(-0.9, 0.9, (count + 40, 1))
    features = np.concatenate([np.cos(turns), np.sin(turns)], axis=1)
    old, new = discs(means), random_candidates()
    old = sc.replace(old, features=features[:count], valid=np.arange(count) % 9 != 4)
    old = sc.replace(old, covs=old.covs * rng.uniform(0.6, 2.0, (count, 1, 1)))
    sizes, colors, normals = rng.uniform(0.6, 6.0, (40, 1, 1)), rng.uniform(0, 1, (40, 3)), rng.normal(size=(40, 3))
    normals = normals * 0.3 + [0, 0, -1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    features[count] = -features[0]
    new = sc.replace(new, features=features[count:], covs=new.covs * sizes, colors=colors, normals=normals)
    weight, T = np.linspace(0.5, 3.0, count), sc.pose((0.02, -0.03, 0.01), (0.05, -0.02, 0.1))
    merged, fresh, info = run(config, camera, new, old, weight, T)
    rows, is_fresh = reference.refine(sc.as_numpy(old), weight, sc.as_numpy(new), sc.matrix_of(T), camera, config)
    np.testing.assert_array_equal(fresh.valid, is_fresh)
    assert len(rows) > 2 < info.num_merged and info.num_fresh == is_fresh.sum() > 5
    assert info.overflow == 0 and info.num_candidates == info.num_merged + info.num_fresh
    g = merged.gaussians
    for k, expected in rows.items():
        # 2D distances of pixels in float32, through an exponential into shares; values of 2 m and less
        for a, b in zip((g.means[k], g.covs[k], g.normals[k], g.colors[k], merged.weight[k]), expected, strict=True):
            np.testing.assert_allclose(a, b, atol=2e-4)
    others = np.setdiff1d(np.arange(count), list(rows))
    sc.assert_same(sc.rows_of(merged, others), sc.rows_of(sc.fresh_map(old, weight), others))


@pytest.mark.parametrize("missing", ["candidate", "map"])
def test_where_a_feature_is_missing_it_says_nothing(settings, camera, missing):
    """As if both were the same: unlabelled pixels are no other surface."""
    old, new = discs(GRID), discs((0.02, 0.01, 2.01))
    expected, _, _ = run(settings, camera, new, old)
    if missing == "candidate":
        new = sc.replace(new, features=np.zeros((1, 2)))
    else:
        old = sc.replace(old, features=np.zeros((len(GRID), 2)))
    merged, _, info = run(settings, camera, new, old)
    assert info.num_merged == 1
    np.testing.assert_array_equal(merged.gaussians.means, expected.gaussians.means)


@pytest.mark.parametrize("feature, cosine", [((0.8, 0.6), 0.8), ((-1.0, 0.0), 0.0)])
def test_the_weight_of_the_cosine_says_how_much_features_decide(settings, camera, feature, cosine):
    """One Gaussian, one candidate: what α = 1 gains is ω, of which 1 - w is there whatever the features are."""
    old, new = discs((0, 0, 2.0), std=0.3), discs((0.02, 0.01, 2.01), std=0.3, feature=feature)
    counted = sc.at(settings, "average.gain", 1.0)
    for share in (0.0, 0.25, 1.0):
        merged, _, info = run(sc.at(counted, "cosine_weight", share), camera, new, old)
        omega = share * cosine + 1.0 - share
        np.testing.assert_allclose(merged.weight, [1.0 + omega], rtol=1e-6)
        assert info.num_merged == (omega > 0)


def random_candidates(count=40, seed=0):
    rng = np.random.default_rng(seed)
    means = rng.uniform([-1.2, -0.9, 1.8], [1.2, 0.9, 2.3], (count, 3))
    return sc.replace(discs(means, std=0.1), valid=np.arange(count) % 5 > 0)


def test_without_candidates_the_map_stays_bit_for_bit(settings, camera):
    nothing = sc.replace(random_candidates(), valid=np.zeros(40, bool))
    merged, fresh, info = run(settings, camera, nothing)
    sc.assert_same(merged, map_of(discs(GRID)))
    assert not fresh.valid.any() and info.num_candidates == 0


def test_an_empty_map_makes_every_candidate_fresh(settings, camera):
    empty = sc.replace(discs(GRID), valid=np.zeros(25, bool))
    merged, _, info = run(settings, camera, random_candidates(), empty)
    assert info.num_fresh == 32
    sc.assert_same(merged, map_of(empty))


def splats(means, is_valid) -> Splats:
    """Round ones of four pixels."""
    n, eye = len(means), np.tile(np.eye(2), (len(means), 1, 1))
    arrays = means, 16 * eye, eye / 16, np.ones(n), np.ones(n), np.ones(n), np.zeros((n, 2)), is_valid, np.ones(n)
    return Splats(*map(sc.device, arrays))


@pytest.mark.parametrize("count", [5, 20, 60, 600])
def test_candidates_however_few_and_scattered_are_matched_with_the_splats_that_are_nearest_to_each(config, count):
    """Late in a run a frame has few, all over the image, among thousands of splats."""
    rng, room = np.random.default_rng(count), (320, 240)
    on_image, means = rng.uniform(size=(3000, 2)) * room, np.zeros((600, 2))
    means[:count] = rng.uniform(size=(count, 2)) * room
    every, config = np.ones(3000, bool), config().refinement
    rows, distance_sq, found = matched(splats(on_image, every), splats(means, np.arange(600) < count), every, config)
    distances, expected = cKDTree(on_image).query(means[:count], config.num_candidates)
    assert found[:count].all() and np.mean(rows[:count] == expected) > 0.99  # the farthest may be another
    np.testing.assert_array_equal(rows[:count, 0], expected[:, 0])
    np.testing.assert_allclose(distance_sq[:count, 0], distances[:, 0] ** 2 / 32, rtol=1e-3, atol=1e-4)  # in float32


@pytest.mark.parametrize(
    ("std", "floor", "count", "stays"),
    [
        (0.05, 0.0, 100, True),  # 1.9 pixels along each axis, 2.7 over both: 3 are allowed
        (0.15, 0.0, 100, False),  # 8 pixels of an image that a hundred cover
        (0.15, 0.0, 4, True),  # an image that four cover: each is a quarter of it
        (0.15, 0.149, 100, True),  # nothing but the floor of the covariances
    ],
)
def test_a_first_frame_has_no_gaussians_of_scattered_points(std, floor, count, stays, config):
    """Symptom: five of six splats wider than 10 cm were of the first frame, whose candidates nothing had tested."""
    camera = Camera(np.float32([75.0, 75.0]), np.float32([19.5, 14.5]), 40, 30)
    means = np.random.default_rng(0).uniform(-0.2, 0.2, (count, 3)) + [0, 0, 2.0]
    first = sc.flat_gaussians(means, std, thickness=max(floor, 0.01))
    settings = config().refinement
    kept = sc.on_host(without_scattered)(first, CAMERA_POSE, camera, sc.device(floor), settings)
    np.testing.assert_array_equal(kept.valid, stays)
    printed = config("slam/refinement=paper").refinement
    assert sc.on_host(without_scattered)(first, CAMERA_POSE, camera, sc.device(floor), printed).valid.all()


@pytest.mark.parametrize("width", [40, 160, 320, 640])  # pixels of the rendered image, half of those of the input
@pytest.mark.parametrize("depth", [0.1, 0.3, 1.0, 4.0])
def test_a_wall_that_comes_into_view_is_mapped_whatever_the_image_and_the_distance(width, depth, config):
    """Symptoms: large images, and what is nearer than 40 cm, added nothing to the map after the first frame.

    A patch of the wall stays, also one of four times its width; what is eight times as wide is scattered points.
    """
    settings = config()
    camera = Camera(np.float32([0.85 * width] * 2), np.float32([width / 2, width * 3 / 8]), width, width * 3 // 4)
    count = min(width * camera.height // 21, 2304)  # patches of an image with `slam.fit` as it is
    floor = float(settings.fit.min_std)
    patch = depth / camera.focal[0] * np.sqrt(width * camera.height / count / 12)  # along one axis
    kept = []
    for length, breadth in ((1.0, 1.0), (2.0, 0.5), (8.0, 1.0)):
        wall = sc.flat_gaussians(np.tile([0.0, 0.0, depth], (count, 1)), 1.0)
        stds = np.hypot([patch * length, patch * breadth, 0.0], floor)
        wall = sc.replace(wall, covs=np.tile(np.diag(stds**2), (count, 1, 1)).astype(np.float32))
        result = sc.on_host(without_scattered)(wall, CAMERA_POSE, camera, sc.device(floor), settings.refinement)
        kept.append(result.valid.mean())
    assert kept == [1.0, 1.0, 0.0]

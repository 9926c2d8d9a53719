"""Normals of exact planes and spheres, rows and masks against plain indexing, rigid motions against matrices."""

from functools import partial

import jax
import jaxlie
import numpy as np
import pytest
import reference
from scene import assert_same, at, moved_points, observe_room, on_host, path_pose, pose, random_observation, replace

from emgs_jax import observation
from emgs_jax.config.values import check_value, declared

normals_from_pointmap, observe, transform = (
    on_host(f) for f in (observation.normals_from_pointmap, observation.observe, observation.transform)
)


def directions_of(camera):
    """Rays of all pixels, with z = 1."""
    (fx, fy), (cx, cy) = np.asarray(camera.focal, float), np.asarray(camera.center, float)
    x, y = (np.arange(camera.width) - cx) / fx, (np.arange(camera.height) - cy) / fy
    return np.stack(np.broadcast_arrays(x, y[:, None], 1.0), axis=-1)


def sample_features(grid, size, thin):
    return on_host(partial(observation.sample_features, size=size, thin=thin))(np.float32(grid))


def plane_points(camera, normal, distance):
    """Camera-frame points of the plane n·X = -distance, n towards the camera."""
    normal, directions = np.asarray(normal) / np.linalg.norm(normal), directions_of(camera)
    return (directions * (-distance / (directions @ normal))[..., None]).astype(np.float32), normal


def degrees(a, b):
    return np.degrees(np.arccos(np.clip(np.sum(np.asarray(a, float) * b, axis=-1), -1, 1)))


EVERY = np.ones((24, 32), bool)


@pytest.mark.parametrize("normal", [(0, 0, -1), (0.5, 0.2, -1), (-0.3, -0.6, -1)])
def test_the_normals_of_a_plane_are_exact_and_face_the_camera(camera, config, normal):
    points, truth = plane_points(camera, normal, 1.5)
    config = at(config().observation, "max_depth_step", 0.3)  # tilted planes leave 5 % a pixel at this resolution
    normals = normals_from_pointmap(points, EVERY, config)
    # Inverse depth is exactly linear; the rest is float32: eps / (a window of .1 rad) ~ 1e-5 rad.
    assert degrees(normals, truth).max() < 0.05
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-5)
    assert (np.sum(normals * points, axis=-1) < 0).all()


def test_the_smallest_window_is_of_three_pixels(camera, config):
    points, truth = plane_points(camera, (0, 0, -1), 1.5)
    smallest = config("slam.observation.normal_radius=1", "slam.observation.normal_spacing=1").observation
    assert degrees(normals_from_pointmap(points, EVERY, smallest), truth).max() < 0.05
    fields = declared(observation.ObservationConfig)
    check_value("normal_radius", 1, fields["normal_radius"])
    with pytest.raises(ValueError, match="normal_radius"):
        check_value("normal_radius", 0, fields["normal_radius"])


@pytest.mark.parametrize(("radius", "spacing"), [(4, 2), (1, 1)])
def test_of_noisy_depths_the_normal_is_that_of_least_squares_over_the_window(camera, config, radius, spacing):
    """A slanted plane with errors of 1 % and holes, at the border, too; a step is 3 %, which some neighbours exceed."""
    words = f"slam.observation.normal_radius={radius}", f"slam.observation.normal_spacing={spacing}"
    settings = config(*words).observation
    rng, (points, _) = np.random.default_rng(0), plane_points(camera, (0.1, 0.15, -1), 1.5)
    points = (points * (1 + 0.01 * rng.normal(size=(24, 32, 1)))).astype(np.float32)
    valid = rng.uniform(size=(24, 32)) < 0.8
    normals = normals_from_pointmap(points, valid, at(settings, "max_depth_step", 0.03))
    compared = 0
    for row, column in np.argwhere(valid)[::7]:
        if np.any(normals[row, column]):
            taps = range(-radius, radius + 1, spacing)
            expected = reference.normal_of_window(points.astype(float), valid, row, column, taps, 0.03)
            # Sums of a window relative to its pixel in float32; .1 rad wide, so 1e-6 of them is 1e-5 rad.
            assert degrees(normals[row, column], expected) < 0.05
            compared += 1
    assert compared > 70


@pytest.mark.parametrize(("count", "has_normal"), [(5, False), (6, True)])
def test_a_normal_needs_more_than_a_fifth_of_its_window(camera, config, count, has_normal):
    settings = config("slam.observation.normal_radius=4", "slam.observation.normal_spacing=2").observation
    points, _ = plane_points(camera, (0, 0, -1), 1.5)
    valid = np.zeros_like(EVERY)
    for row, column in [(12, 16), (14, 16), (12, 18), (10, 14), (16, 12), (8, 20)][:count]:
        valid[row, column] = True
    normals = normals_from_pointmap(points, valid, settings)
    assert (np.linalg.norm(normals[12, 16]) > 0.99) == has_normal


def test_pixels_in_one_row_alone_determine_no_normal(camera, config):
    """Three of nine, more than a fifth, but collinear: any plane through the line fits."""
    points, _ = plane_points(camera, (0.3, 0.2, -1), 1.5)
    valid = np.zeros_like(EVERY)
    valid[::4] = True
    config = at(config().observation, "max_depth_step", 0.3)
    np.testing.assert_array_equal(normals_from_pointmap(points, valid, config), 0)


def example(camera, num_features=2):
    rng = np.random.default_rng(0)
    points, _ = plane_points(camera, (0.1, 0.1, -1), 1.5)
    images = rng.uniform(0, 1, (24, 32, 3)), rng.normal(size=(24, 32, num_features)), rng.uniform(1, 2, (24, 32))
    return [points, *(x.astype(np.float32) for x in images), EVERY.copy()]


@pytest.mark.parametrize("thin", [1, 5])
def test_a_row_is_a_pixel_of_the_thinned_image_row_major(camera, config, thin):
    inputs = example(camera)
    o = observe(*inputs, config(f"slam.observation.thin={thin}").observation)
    points, colors, features, confidence, _ = (x[::thin, ::thin].reshape(-1, *x.shape[2:]) for x in inputs)
    for actual, expected in zip(
        (o.points, o.colors, o.features, o.confidence), (points, colors, features, confidence), strict=True
    ):
        np.testing.assert_array_equal(actual, expected)
    assert o.valid.all()
    full = normals_from_pointmap(inputs[0], EVERY, config().observation)[::thin, ::thin].reshape(-1, 3)
    # Normals come from the full point map, here by another program: float32 over a window of .1 rad.
    np.testing.assert_allclose(o.normals, full, atol=2e-5)


@pytest.mark.parametrize("thin", [1, 3])
@pytest.mark.parametrize("cells", [(5, 7), (48, 40), (1, 1)])
def test_a_grid_of_features_is_sampled_at_the_pixels_by_the_rule_of_its_centres(thin, cells):
    """A feature that is linear in the position, before it is made a unit vector, is met exactly between the centres."""
    (height, width), (rows, columns) = (24, 33), cells
    at_row, at_column = (np.arange(n) + 0.5 for n in cells)  # of the centres, in cells
    v, u = at_row * height / rows - 0.5, at_column * width / columns - 0.5  # in pixels

    def feature(v, u):
        return np.stack(np.broadcast_arrays(1.0, 0.1 * v[:, None], -0.2 * u[None, :]), axis=-1)

    sampled = sample_features(feature(v, u), (height, width), thin)
    pixels = np.arange(0, height, thin).clip(v[0], v[-1]), np.arange(0, width, thin).clip(u[0], u[-1])
    expected = feature(*pixels)
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    np.testing.assert_allclose(sampled, expected, atol=2e-6)  # float32


def test_a_grid_of_one_cell_per_pixel_is_taken_bit_for_bit():
    grid = np.random.default_rng(0).normal(size=(6, 9, 4)).astype(np.float32)
    np.testing.assert_array_equal(sample_features(grid, (6, 9), 2), grid[::2, ::2])


def test_an_observation_holds_the_sampled_features_where_it_is_valid(camera, config):
    points, colors, _, confidence, mask = example(camera)
    mask[6:9, 4:7] = False
    grid = np.random.default_rng(1).normal(size=(3, 4, 5)).astype(np.float32)
    o = observe(points, colors, grid, confidence, mask, config("slam.observation.thin=2").observation)
    expected = sample_features(grid, (24, 32), 2).reshape(-1, 5)
    np.testing.assert_allclose(o.features, np.where(o.valid[:, None], expected, 0), atol=1e-6)
    assert not o.valid.all()


def test_a_point_without_a_normal_is_no_measurement_and_its_row_is_neutral(camera, config):
    """A pixel alone in a hole; its values, which no one may read, are those of a row that is not there."""
    points, colors, features, confidence, mask = example(camera)
    mask[9:14, 9:14] = False
    mask[11, 11] = True
    o = observe(points, colors, features, confidence, mask, config().observation)
    valid = np.asarray(o.valid).reshape(24, 32)
    assert not valid[9:14, 9:14].any() and valid.sum() == 768 - 25
    gone = ~np.asarray(o.valid)
    np.testing.assert_array_equal(o.confidence[gone], 1)
    assert not any(np.asarray(x[gone]).any() for x in (o.colors, o.features, o.normals))


def test_what_a_surface_is_known_by_is_what_an_observation_keeps(camera, config):
    """Holes, a point behind the camera, one beyond any map and one alone; colours and confidence have no say."""
    points, colors, features, confidence, mask = example(camera)
    mask[9:14, 9:14], mask[11, 11] = False, True
    points[3, 4, 2], points[20, 21], points[15, 20:] = -1.0, 1e30, [0, 0, 0]
    settings = config().observation
    expected = np.asarray(observe(points, colors, features, confidence, mask, settings).valid).reshape(24, 32)
    np.testing.assert_array_equal(on_host(observation.known_surface)(points, mask, settings), expected)
    assert 0.9 < expected.mean() < 1 - 25 / 768


def test_the_least_confidence_is_enough_and_a_point_at_depth_zero_is_none(camera, config):
    points, colors, features, confidence, mask = example(camera)
    confidence[4, 5] = 1.0
    points[20, 7] = points[20, 7] * [1, 1, 0]
    o = observe(points, colors, features, confidence, mask, config().observation)
    assert o.valid[4 * 32 + 5] and not o.valid[20 * 32 + 7] and o.valid.sum() == 767


def test_features_of_width_zero_are_possible(camera, config):
    o = observe(*example(camera, num_features=0), config().observation)
    assert o.features.shape == (768, 0) and o.valid.all()


@pytest.mark.parametrize("name", ["nan", "inf", "behind", "mask", "confidence"])
def test_a_pixel_that_is_no_measurement_is_invalid_finite_and_changes_no_other(camera, config, name):
    points, colors, features, confidence, mask = example(camera)
    row, column = divmod(330, 32)
    without = mask.copy()
    without[row, column] = False
    clean = observe(points, colors, features, confidence, without, config().observation)
    if name in ("nan", "inf", "behind"):
        points[row, column] = {"nan": np.nan, "inf": np.inf, "behind": -1.0}[name]
    elif name == "mask":
        mask[row, column] = False
    else:
        confidence[row, column] = 0.5
    o = observe(points, colors, features, confidence, mask, config().observation)
    assert not o.valid[330] and o.valid.sum() == 767
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(o))
    np.testing.assert_array_equal(o.points, clean.points)
    np.testing.assert_array_equal(o.normals, clean.normals)


def test_a_transform_scales_about_the_source_then_moves_points_and_turns_normals(camera):
    o = observe_room(path_pose(2), camera, num_features=2)
    T = pose((0.3, -0.5, 0.8), (1.0, -2.0, 3.0))
    moved, expected = transform(T, o, np.float32(1.7)), moved_points(T, o, 1.7)
    np.testing.assert_allclose(moved.points, expected.points, atol=3e-6)  # roundings of coordinates of a few metres
    np.testing.assert_allclose(moved.normals, expected.normals, atol=1e-6)
    for name in ("colors", "features", "confidence", "valid"):
        assert_same(getattr(moved, name), getattr(o, name))


@pytest.mark.parametrize("what", ["points", "colors", "features", "confidence"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_a_number_that_is_none_leaves_its_pixel_out_and_no_other(camera, config, what, value):
    points, _ = plane_points(camera, (0, 0, -1), 1.5)
    given = {
        "points": points,
        "colors": np.full((24, 32, 3), 0.5, np.float32),
        "features": np.full((24, 32, 2), 0.5**0.5, np.float32),
        "confidence": np.ones((24, 32), np.float32),
    }
    clean = observe(*given.values(), EVERY, config().observation)
    given[what][5, 6] = value
    found = observe(*given.values(), EVERY, config().observation)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found) if value != 1e30 or what == "points")
    others = np.arange(24 * 32) != 5 * 32 + 6
    np.testing.assert_array_equal(found.valid[others], clean.valid[others])
    if what == "points" or (what in ("colors", "confidence") and value != 1e30):
        assert not found.valid[~others].any()


def test_a_pose_whose_quaternion_is_none_is_unknown_and_one_that_is_too_long_or_short_is_made_a_unit():
    """Of a matrix rigid to three decimals: each frame multiplied the length of all poses after it by its own."""
    values = np.float32([[1, 0, 0, 0, 1, 2, 3], [0, 0, 0, 0, 1, 2, 3], [1, 0, 0, 0, 1e30, 2, 3], [np.nan] * 7])
    turned = np.float32([0.1, 0.5, 0.7, 0.5, 1, 2, 3])
    lengths = 0.97, 1.0, 1.03, 0.9, 1.1  # the last two are too far from a unit for a rounded one
    values = np.concatenate([values, [turned * [f, f, f, f, 1, 1, 1] for f in lengths]]).astype(np.float32)
    found = on_host(observation.sound_poses)(jaxlie.SE3(values)).wxyz_xyz
    np.testing.assert_array_equal(np.isfinite(found).all(axis=1), [True] + [False] * 3 + [True] * 3 + [False] * 2)
    np.testing.assert_array_equal(found[[0, 5]], values[[0, 5]])
    np.testing.assert_allclose(found[[4, 6]], [turned] * 2, rtol=1e-6)


def test_a_covariance_that_is_none_is_unknown_and_one_of_a_single_error_is_known():
    errors = np.ones((6, 6)), 1e6 * np.eye(6), np.zeros((6, 6)), np.diag([1, 1, 1, 1, 1, -1e-3]), np.eye(6) + 2
    values = np.float32([*errors, 2 * np.ones((6, 6)) - np.eye(6) * 1.1, np.full((6, 6), np.nan)])
    found = on_host(observation.sound_covariances)(values)
    assert np.isfinite(found).all((1, 2)).tolist() == [True, True, True, False, True, False, False]
    np.testing.assert_array_equal(found[:3], values[:3])


def test_a_colour_is_one_of_an_image():
    given = random_observation(4)
    colors = np.float32([[0, 0.5, 1], [1e30, 0.5, 0.5], [-3, 0, 0.25], [np.nan, 0, 0]])
    found = on_host(observation.sound)(replace(given, colors=colors))
    np.testing.assert_array_equal(found.colors, [[0, 0.5, 1], [1, 0.5, 0.5], [0, 0, 0.25], [0, 0, 0]])
    assert found.valid.tolist() == [True, True, True, False]

"""ICP against the closed form of small problems, the true pose of a closed room, and Open3D from the same starts."""

import numpy as np
import open3d as o3d
import pytest
import reference
import scene as sc

from emgs_jax.gaussians import Gaussians, color_gradients, fit_to_points
from emgs_jax.observation import Observation
from emgs_jax.registration.icp import icp
from emgs_jax.registration.noise import NUM_CELLS
from emgs_jax.registration.problem import CoarseStart

RESIDUALS = {"colored": 0, "distribution": 1, "colored+distribution": 2, "colored+ray": 3}
NOISE = 0.02, 0.01  # of the coarse position, m, and of depths, a fraction, and the coarse rotation, rad
STARTS = [
    sc.pose((0.02, -0.02, 0.01), (0.03, 0.02, -0.03)),
    sc.pose((-0.01, 0.03, 0.0), (-0.04, 0.01, 0.02)),
    sc.pose((0.015, 0.01, -0.025), (0.01, -0.04, 0.03)),
    sc.pose((0.0, 0.0, 0.03), (0.03, 0.03, 0.03)),
]


def start_at(T, settings, pose_std=NOISE[0], depth_noise=NOISE[1], is_given=False):
    """Known: what `prior_information` points so noisy say of the pose, and `scale_noise` of the scale."""
    pose = np.sqrt(float(settings.prior_information)) / np.repeat([pose_std, depth_noise], 3)
    scale = 1.0 / (max(float(settings.scale_noise), 1e-3) * depth_noise)
    known = sc.device(np.diag(np.append(pose, scale)))
    return CoarseStart(T, known, sc.device(np.float32(depth_noise)), sc.device(is_given))


solve, gradients_of = sc.on_host(icp), sc.on_host(color_gradients)
TRUTH = sc.path_pose(2)


# Problems of 16 points, each many times, and a few Gaussians, whose answer is a linear system; all is in the coarse
# camera's frame, whose pose is any. The closed room below has as many rows, so that all is one program.

COARSE = sc.pose((0.4, -0.9, 0.3), (0.5, 1.0, -0.7))
step_to = sc.on_host(lambda T: (COARSE.inverse() @ T).log())
NUM_POINTS, NUM_GAUSSIANS = 768, 384
TOWARDS = (0.0, 0.0, -1.0)
# A coarse pose known to 2 cm, whose rotation and scale are as good as held.
POSE_STD, STIFF = 0.02, 1e-4


@pytest.fixture(scope="module")
def exactly(config):
    """Half of all rows, enough steps."""
    more = "num_points=768", "max_steps=40", "tolerance=1e-6"
    return config(*(f"slam.localization.icp.{value}" for value in more)).localization.icp


@pytest.fixture(scope="module")
def small(exactly):
    # A `max_misfit` of 0 leaves the noise as it is given.
    return sc.changed(exactly, prior_information=30.0, noise=0.0, scale_noise=0.0, max_misfit=0.0)


def gaussians_of(means, stds, normals=TOWARDS, colors=0.5) -> Gaussians:
    """Valid Gaussians, camera frame, with standard deviations along the axes, and free rows with wild values."""
    means, count = np.atleast_2d(means), len(np.atleast_2d(means))
    covs = np.zeros((count, 3, 3))
    covs[:, range(3), range(3)] = np.broadcast_to(stds, (count, 3)) ** 2
    colors = np.broadcast_to(np.reshape(colors, (-1, 1)), (count, 3))

    def padded(rows, wild):
        filled = np.full((NUM_GAUSSIANS, *rows.shape[1:]), wild)
        filled[:count] = rows
        return sc.device(filled)

    normals = np.broadcast_to(normals, (count, 3))
    arrays = padded(means, 7.0), padded(covs, 0.0), padded(colors, 9.0), padded(normals, 0.5)
    return Gaussians(*arrays, sc.device(np.zeros((NUM_GAUSSIANS, 0))), sc.device(np.arange(NUM_GAUSSIANS) < count))


def on_even_rows(points, normals, colors, valid) -> Observation:
    """The points again and again; on odd rows, which are not to be looked at, wild values."""

    def spread(rows, wild):
        rows = np.resize(rows, (NUM_POINTS, *np.shape(rows)[1:]))
        return sc.device(np.stack([rows, np.full_like(rows, wild)], axis=1).reshape(-1, *rows.shape[1:]))

    arrays = (spread(np.asarray(x, np.float32), 0.1) for x in (points, colors, normals))
    rows = 2 * NUM_POINTS
    return Observation(*arrays, sc.device(np.zeros((rows, 0))), sc.device(np.ones(rows)), spread(valid, True))


def points_of(points, normals=TOWARDS, light=0.5, valid=True) -> Observation:
    points = np.atleast_2d(points)
    colors = np.tile(np.broadcast_to(light, len(points))[:, None], 3)
    return on_even_rows(points, np.broadcast_to(normals, points.shape), colors, np.broadcast_to(valid, len(points)))


def solved(points, gaussians, settings, pose_std=POSE_STD, depth_noise=STIFF, is_given=False):
    """xi of T = COARSE exp(xi), the scale and the info."""
    start = start_at(COARSE, settings, pose_std, depth_noise, is_given)
    T, scale, info = solve(points, sc.move_gaussians(COARSE, gaussians), start, settings)
    return step_to(T).astype(float), float(scale), info


def stated(points, gaussians, settings, pose_std=POSE_STD, depth_noise=STIFF):
    """The same by `reference.registered`; the first passes of the points are enough."""
    some = slice(0, 32, 2)
    keep = np.asarray(points.valid)[some]
    x, normals, colors = (np.asarray(x, float)[some][keep] for x in (points.points, points.normals, points.colors))
    g, valid = sc.as_numpy(gaussians), np.asarray(gaussians.valid)
    gradients = gradients_of(gaussians, settings.num_color_neighbours).astype(float)[valid]
    g = {name: rows[valid] for name, rows in g.items()}
    noise = float(settings.noise) * depth_noise * x
    light = colors @ [0.299, 0.587, 0.114]
    return reference.registered(x, normals, light, noise, g, gradients, settings, pose_std)


def assert_as_stated(xi, expected):
    """The solver stops where a step is a 1e-6th; products of 1e9 (what is held) and 1e5 lose a few digits more."""
    np.testing.assert_allclose(xi[:3], expected, atol=5e-3 * np.abs(expected).max() + 1e-6)
    np.testing.assert_allclose(xi[3:], 0, atol=1e-5)


WALL = gaussians_of((0, 0, 2.0), (1.0, 1.0, 0.02))
SHEARED = [(0.03, -0.02, 2.02), (0.02, 0.03, 2.01)]


@pytest.mark.parametrize("residual", RESIDUALS)
@pytest.mark.parametrize(
    "change",
    [
        {},
        {"prior_information": 90.0},
        {"noise": 100.0},  # times 1e-4 of 2 m: 2 cm along the ray
    ],
    ids=lambda change: "-".join(change) or "as it is",
)
def test_points_and_prior_share_the_offset_by_their_information(small, residual, change):
    """Offsets of some centimetres from a Gaussian with deviations of 6, 4 and 2 cm: the answer is a linear system."""
    settings = sc.changed(small, residual=RESIDUALS[residual], **change)
    gaussians = gaussians_of((0, 0, 2.0), (0.06, 0.04, 0.02))
    points = points_of(SHEARED)
    expected = stated(points, gaussians, settings)
    assert np.abs(expected).max() > 1e-3
    xi, scale, _ = solved(points, gaussians, settings)
    assert_as_stated(xi, expected)
    assert scale == 1


def test_the_coarse_poses_own_noise_is_in_metres(small):
    """A wall half a sigma away: t = d A / (A + B) with A = 16 / σ², B = information / pose_std²."""
    settings = sc.at(small, "residual", RESIDUALS["colored"])
    for pose_std in (0.01, 0.02, 0.05):
        xi, _, _ = solved(points_of((0, 0, 2.01)), WALL, settings, pose_std)
        points, prior = NUM_CELLS**2 / 0.02**2, 30 / pose_std**2
        assert_as_stated(xi, [0, 0, -0.01 * points / (points + prior)])


def test_the_noise_of_depth_holds_the_rotation_in_radians(small):
    """Two walls, one a centimetre nearer to the left, one farther to the right, turn the camera about its y axis."""
    settings = sc.at(small, "residual", RESIDUALS["colored"])
    walls = gaussians_of([(1, 0, 2.01), (-1, 0, 1.99)], (0.3, 0.3, 0.02))
    for depth_noise in (0.005, 0.01):
        xi, _, _ = solved(points_of([(1, 0, 2), (-1, 0, 2)]), walls, settings, 1e-4, depth_noise)
        points, prior = NUM_CELLS**2 / 0.02**2, 30 / depth_noise**2
        expected = -0.01 * points / (points + prior)
        np.testing.assert_allclose(xi[3:], [0, expected, 0], atol=0.01 * abs(expected))  # sin θ for θ = 1e-2


def test_the_scale_is_held_in_units_of_the_depth_noise(small):
    """y = d z s A / (1 + (z s)² A) for the scale exp(s y), s = scale_noise · depth_noise, where the pose is held."""
    settings = sc.changed(small, residual=RESIDUALS["colored"], prior_information=1e6)
    for scale_noise in (0.2, 0.5):
        _, scale, _ = solved(
            points_of((0, 0, 2)),
            gaussians_of((0, 0, 2.01), (1, 1, 0.02)),
            sc.at(settings, "scale_noise", scale_noise),
            1e-3,
            0.01,
        )
        s, points = scale_noise * 0.01, NUM_CELLS**2 / 0.02**2
        expected = s * (2 * s * points * 0.01) / (1 + (2 * s) ** 2 * points)
        assert np.log(scale) == pytest.approx(expected, rel=0.02)  # exp(s y) is linear up to s y = 5e-3


@pytest.mark.parametrize(("difference", "gate"), [(0.05, 9.0), (0.35, 9.0), (0.34, 25.0)])
def test_an_intensity_pulls_along_its_gradient_unless_it_is_beyond_the_gate(small, difference, gate):
    """Grey Gaussians that get brighter to the right; .35 is 3.5 deviations."""
    x = np.arange(-5, 6) * 0.3
    ramp = gaussians_of(np.stack([x, 0 * x, 0 * x + 2], axis=-1), (0.25, 0.25, 0.02), colors=0.5 + 0.5 * x)
    settings = sc.changed(small, residual=RESIDUALS["colored"], max_mahalanobis_sq=gate)
    points = points_of((0.01, 0, 2), light=0.5 + difference)
    expected = stated(points, ramp, settings, 0.1, 1e-3)
    assert (abs(expected[0]) > 0.003) == (difference**2 < 0.01 * gate)
    xi, _, _ = solved(points, ramp, settings, 0.1, 1e-3)
    # Rotation gives way by a hundredth.
    np.testing.assert_allclose(xi[:3], expected, atol=0.02 * abs(expected[0]) + 1e-5)


@pytest.mark.parametrize(
    ("point", "normal", "valid"),
    [((0, 0, 2.07), TOWARDS, True), ((0.0, 0.0, 2.01), (0.9, 0, -0.436), True), ((0, 0, 2.01), TOWARDS, False)],
    ids=["3.5 deviations away", "turned by 64 degrees", "invalid"],
)
def test_a_point_that_no_gaussian_explains_pulls_nowhere_but_counts_unless_it_is_invalid(small, point, normal, valid):
    settings = sc.at(small, "residual", RESIDUALS["colored"])
    points = points_of([(0, 0, 2.01), point], normals=[TOWARDS, normal], valid=[True, valid])
    xi, _, info = solved(points, WALL, settings)
    data, prior = NUM_CELLS**2 / 0.02**2 / (2 if valid else 1), 30 / POSE_STD**2
    assert_as_stated(xi, [0, 0, -0.01 * data / (data + prior)])
    assert info.num_inliers == NUM_POINTS // 2 and info.inlier_fraction == (0.5 if valid else 1.0)


@pytest.mark.parametrize("noise", [0.0, 500.0])
def test_a_point_belongs_to_the_gaussian_that_explains_it_best_with_its_noise(small, noise):
    """The nearer one is a wall before the point, the other a post beside it: along the ray the point may be wrong."""
    two = gaussians_of([(0.02, 0, 2.06), (0.1, 0, 2.0)], [(0.05, 0.05, 0.018), (0.04, 0.04, 0.02)])
    settings = sc.changed(small, residual=RESIDUALS["distribution"], noise=noise, max_mahalanobis_sq=25.0)
    points = points_of((0, 0, 2.0))
    rays = noise * STIFF * np.array([[0, 0, 2.0]])
    g = {name: rows[:2] for name, rows in sc.as_numpy(two).items()}
    row, _ = reference.matched(np.array([[0, 0, 2.0]]), np.array([TOWARDS]), rays, g, (25.0, 0.5))
    assert row[0] == (0 if noise else 1)
    xi, _, _ = solved(points, two, settings)
    assert_as_stated(xi, stated(points, two, settings))


def test_the_second_search_looks_where_the_first_solve_has_moved_the_points(small):
    """Most points pull by .4 m to the right, where the others find what they had eight nearer ones before it to see."""
    settings = sc.changed(small, residual=RESIDUALS["distribution"], prior_information=1e-3)
    seen, hidden = (0.0, 0.5, 2.0), (0.0, -0.5, 2.0)
    before = [(-0.3, -0.5 + 0.01 * i, 2.0) for i in (-4, -3, -2, -1, 1, 2, 3, 4)]
    assert len(before) == settings.num_neighbours
    target = gaussians_of([(0.4, 0.5, 2.0), *before, (0.4, -0.5, 2.0)], [(0.2, 0.2, 0.2), *[(0.02, 0.02, 0.02)] * 9])
    xi, _, info = solved(points_of([seen] * 7 + [hidden]), target, settings)
    assert info.num_inliers == NUM_POINTS
    np.testing.assert_allclose(xi[:3], [0.4, 0, 0], atol=1e-3)


def test_the_info_says_what_the_points_at_the_held_pose_look_like(small):
    settings = sc.changed(small, prior_information=1e9, max_misfit=0.5)
    away = np.array([0.01, -0.02, 0.03, 0.04, -0.05, 0.005, 0.3, 0.02])
    normals = np.tile(TOWARDS, (8, 1))
    normals[5] = 1.0, 0.0, 0.0
    points = points_of([(0, 0, 2 + d) for d in away], normals=normals, valid=np.arange(8) < 7)
    _, _, info = solved(points, WALL, settings, 1e-3, 1e-3)
    assert info.num_inliers == NUM_POINTS // 8 * 5 and info.inlier_fraction == pytest.approx(5 / 7)
    # Roundings of coordinates of 2 m, here and below.
    part = away / (2 + away)  # of the depth
    assert info.residual == pytest.approx(np.sqrt(np.mean(part[:5] ** 2)), abs=1e-6)
    assert info.misfit == pytest.approx(1.4826 * part[2], abs=2e-6)  # the median of seven
    assert info.misfit_of_levels == pytest.approx(float(info.misfit))  # equal confidences
    _, _, info = solved(points, WALL, sc.at(settings, "max_misfit", 0.1), 1e-3, 1e-3)
    assert info.misfit == pytest.approx(1.4826 * -part[1], abs=2e-6)  # the lower median of the six without .3 m


def test_a_pose_is_held_no_harder_than_the_points_fit_the_map_there(small):
    """A coarse pose that claims 1 mm, and points that say 3 cm: the offset is shared as by one that claims 3 cm."""
    spread = np.linspace(-0.3, 0.3, NUM_CELLS)
    points = points_of([(x, y, 2.03) for x in spread for y in spread])  # errors that are all alike, one for each cell
    settings = sc.at(small, "residual", RESIDUALS["colored"])
    misfit = 1.4826 * 0.03 / 2.03  # of the depth
    claimed = 1e-3 / 2.03
    expected, _, _ = solved(points, WALL, settings, 1e-3 * misfit / claimed, misfit)
    found, _, _ = solved(points, WALL, sc.at(settings, "max_misfit", 0.1), 1e-3, claimed)
    np.testing.assert_allclose(found, expected, atol=1e-5)  # the solver's tolerance
    held, _, _ = solved(points, WALL, settings, 1e-3, claimed)
    assert abs(held[2]) < 0.2 * abs(expected[2]) < 0.03
    # Of a pose that comes with its uncertainty the misfit says nothing.
    given, _, _ = solved(points, WALL, sc.at(settings, "max_misfit", 0.1), 1e-3, claimed, is_given=True)
    sure, std = 30 / 1e-6, np.hypot(0.02, misfit * 2.03 * float(settings.noise))
    assert_as_stated(given, [0, 0, -0.03 / (1 + sure * std**2 / NUM_CELLS**2)])
    # What is farther away than `max_misfit` shows something else.
    other, _, _ = solved(points, WALL, sc.at(settings, "max_misfit", 0.01), 1e-3, claimed)
    np.testing.assert_allclose(other, held, atol=1e-6)


@pytest.mark.parametrize("arm", [0.5, 2.0])
def test_the_certainty_of_a_pose_is_that_of_points_and_prior_together(small, arm):
    """Planes through points at ±a on the axes, facing the next axis: N I / 3σ², for rotation a² as much.

    The median depth of a half, of a half of one point and more, is the unit of the translation.
    """
    axes = arm * np.concatenate([np.eye(3), -np.eye(3)]) + [0, 0, 2.0]
    normals = np.tile(np.roll(np.eye(3), 1, axis=1), (2, 1))
    points, gaussians = points_of(axes, normals), gaussians_of(axes, (0.1, 0.1, 0.1), normals)
    # The rows of exact points, x × n about the camera.
    rows = np.hstack([normals, np.cross(axes, normals)]) * np.repeat([2.0, 1.0], 3) / 0.1
    for settings, known in ((sc.at(small, "prior_information", 0.0), 0.0), (small, 30.0)):
        _, _, info = solved(points, gaussians, settings, 0.02, 0.01)
        information = float(info.num_effective) / 6 * rows.T @ rows
        information += np.diag(np.repeat([known * (2.0 / 0.02) ** 2, known / 0.01**2], 3))
        assert info.min_eigenvalue == pytest.approx(np.linalg.eigvalsh(information)[0], rel=2e-3)


# The closed room.


@pytest.fixture(scope="module")
def source(camera):
    seen = sc.observe_room(TRUTH, camera)
    return on_even_rows(seen.points, seen.normals, seen.colors, seen.valid)


@pytest.fixture(scope="module")
def target(camera, config):
    """Gaussians of the room, fitted to the exact points of another view."""
    other = sc.path_pose(0)
    world = sc.moved_points(other, sc.observe_room(other, camera))
    return sc.on_host(fit_to_points)(np.asarray(world.points)[::2], np.ones(384, bool), world, config().fit)


@pytest.fixture(scope="module")
def settings(exactly):
    """No prior, wide gates: what is tested is where the data term has its minimum."""
    return sc.changed(exactly, prior_information=0.0, max_mahalanobis_sq=25.0)


def errors(target, source, config, starts):
    poses = [solve(source, target, start_at(sc.product(TRUTH, start), config), config)[0] for start in starts]
    return np.array([sc.pose_error(T, TRUTH) for T in poses])


@pytest.mark.parametrize("residual", RESIDUALS)
def test_every_residual_recovers_the_pose_in_a_closed_room(source, target, settings, residual):
    found = errors(target, source, sc.at(settings, "residual", RESIDUALS[residual]), STARTS)
    # From 5 cm and 2 degrees; pixels and Gaussians are 10 cm apart. Gaussians across the edges are no planes
    # and leave some millimetres; the offsets from such sparse means (R9) leave up to a quarter of the spacing.
    limit = 0.025 if "distribution" in residual else 0.01  # of the centres, which are no landmarks
    assert found[:, 0].max() < limit, found
    assert found[:, 1].max() < limit, found


def cloud(points, normals, colors):
    result = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    result.normals, result.colors = o3d.utility.Vector3dVector(normals), o3d.utility.Vector3dVector(colors)
    return result


@pytest.mark.parametrize(("residual", "rival"), [("colored", "colored"), ("distribution", "plane")])
def test_the_error_is_no_larger_than_open3ds_from_the_same_starts(source, target, settings, residual, rival):
    method = o3d.pipelines.registration
    g, o = sc.as_numpy(target), [np.asarray(x, float)[::2] for x in (source.points, source.normals, source.colors)]
    clouds = cloud(*o), cloud(g["means"], g["normals"], g["colors"])
    limit = method.ICPConvergenceCriteria(max_iteration=50)
    theirs = []
    for start in STARTS:
        begin = sc.matrix_of(sc.product(TRUTH, start))
        if rival == "colored":
            estimate = method.TransformationEstimationForColoredICP()
            result = method.registration_colored_icp(*clouds, 0.3, begin, estimate, limit)
        else:
            estimate = method.TransformationEstimationPointToPlane()
            result = method.registration_icp(*clouds, 0.3, begin, estimate, limit)
        theirs.append(sc.pose_error(sc.pose_of(result.transformation), TRUTH))
    ours = errors(target, source, sc.at(settings, "residual", RESIDUALS[residual]), STARTS)
    assert (ours.mean(0) <= 1.2 * np.mean(theirs, axis=0) + 1e-4).all(), (ours.mean(0), np.mean(theirs, axis=0))


def test_the_info_counts_inliers_and_measures_their_planes(source, target, settings):
    T, _, info = solve(source, target, start_at(sc.product(TRUTH, STARTS[0]), settings), settings)
    assert 0.5 * 768 < info.num_inliers <= 768
    assert info.inlier_fraction == pytest.approx(float(info.num_inliers) / 768)
    assert info.residual < 0.02 and info.misfit < 0.02  # exact points: only edges are off their planes
    assert info.min_eigenvalue > 100 and info.num_steps > 0
    _, _, strict = solve(source, target, start_at(TRUTH, settings), sc.at(settings, "min_normal_cos", 1.1))
    assert strict.num_inliers == 0 and strict.inlier_fraction == 0 and strict.residual == 0


@pytest.mark.parametrize("residual", RESIDUALS)
def test_a_single_plane_does_not_determine_the_pose(source, target, settings, residual):
    wall = target.normals[:, 2] < -0.99
    plain = sc.replace(target, valid=wall, colors=np.full((384, 3), 0.5))
    facing = sc.replace(source, colors=np.full((2 * NUM_POINTS, 3), 0.5))
    config = sc.at(settings, "residual", RESIDUALS[residual])
    _, _, whole = solve(source, target, start_at(TRUTH, config), config)
    _, _, flat = solve(facing, plain, start_at(TRUTH, config), config)
    assert wall.sum() > 30 and flat.num_inliers > 50
    assert flat.min_eigenvalue < 1e-3 * whole.min_eigenvalue


def test_without_any_gaussian_or_point_the_coarse_pose_stays(source, target, settings):
    empty, blind = (
        sc.replace(target, valid=np.zeros(384, bool)),
        sc.replace(source, valid=np.zeros(2 * NUM_POINTS, bool)),
    )
    for points, gaussians in ((source, empty), (blind, target)):
        T, _, info = solve(points, gaussians, start_at(TRUTH, settings), settings)
        assert info.num_inliers == 0
        assert max(sc.pose_error(T, TRUTH)) < 1e-6


@pytest.mark.parametrize(("max_field", "factor"), [(0.2, 1.05), (0.02, 1.0)])
def test_the_field_is_what_depths_err_by_together_and_what_is_beyond_its_gate_says_nothing_of_it(
    source, target, settings, max_field, factor
):
    held = sc.changed(settings, prior_information=1e9, max_field=max_field)
    _, _, info = solve(sc.replace(source, points=np.asarray(source.points) * 1.05), target, start_at(TRUTH, held), held)
    np.testing.assert_allclose(np.median(info.field.nodes), np.log(factor), atol=0.015)

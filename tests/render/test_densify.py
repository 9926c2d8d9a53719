"""One point per pixel: exact on a plane of Gaussians, moved by rigid motions, opaque where a surface is in front."""

import jax
import numpy as np
import pytest
import scene as sc

from emgs_jax.gaussians import Gaussians
from emgs_jax.ops.camera import Camera
from emgs_jax.render.composite import render
from emgs_jax.render.densify import DensifyConfig, densify, without_floor
from emgs_jax.render.project import project_gaussians

NUM_ROWS = 1080  # of every map, many of them free: one program for all
drawn_dense = sc.on_host(densify)


def dense(gaussians: Gaussians, *arguments):
    return drawn_dense(filled(gaussians), *arguments)


def filled(gaussians: Gaussians) -> Gaussians:
    """With free rows after them."""
    rows, count = np.arange(NUM_ROWS), gaussians.valid.shape[0]
    more = sc.rows_of(gaussians, np.minimum(rows, count - 1))
    return sc.replace(more, valid=more.valid & (rows < count))


def wall(depth: float, normal=(0.0, 0.0, -1.0), step: float = 0.15) -> Gaussians:
    """Discs on a grid on the plane through (0, 0, depth) with a normal."""
    x, y = (a.reshape(-1) for a in np.meshgrid(np.arange(-2, 2, step), np.arange(-1.5, 1.5, step)))
    z = depth - (normal[0] * x + normal[1] * y) / normal[2]
    return sc.flat_gaussians(np.stack([x, y, z], -1), step / 2, normal, color=(0.2, 0.5, 0.8))


@pytest.fixture(scope="module")
def densify_config(config):
    return DensifyConfig(min_std=0.0, render=config("render.tile_capacity=600").refinement.render, points="map")


def test_the_points_of_a_slanted_wall_lie_on_it_with_its_normal_and_colour(camera, densify_config):
    normal = np.array([0.3, 0.2, -1.0]) / np.linalg.norm([0.3, 0.2, -1.0])
    # Without the blur: a splat's depth is kept within its own extent, which blur widens on the image only.
    view = dense(wall(2.0, normal), sc.pose(), camera, sc.at(densify_config, "render.blur", 0.0))
    valid = view.valid
    assert view.rendering.overflow == 0 and valid.mean() > 0.95
    distance = (view.points[valid] - [0, 0, 2]) @ normal
    assert np.abs(distance).max() < 1e-3  # m; every splat's depth is exact for its plane
    np.testing.assert_allclose(view.normals[valid], np.tile(normal, (valid.sum(), 1)), atol=1e-4)
    np.testing.assert_allclose(view.colors[valid], np.tile([0.2, 0.5, 0.8], (valid.sum(), 1)), atol=1e-4)


def test_the_map_is_drawn_with_the_coverage_of_densification(camera, densify_config):
    image, far, thin = sc.on_host(render), filled(wall(2.0)), sc.at(densify_config, "render.opacity", 0.1)
    whole = image(far, far.colors, sc.pose(), camera, thin.render)
    half = float(np.median(whole.alpha))  # so that half of the pixels have a depth
    view = dense(far, sc.pose(), camera, sc.at(thin, "min_alpha", half))
    expected = image(far, far.colors, sc.pose(), camera, sc.at(thin.render, "min_alpha", half))
    for name in ("alpha", "depth", "depth_std"):  # roundings; a standard deviation is the root of a difference
        np.testing.assert_allclose(getattr(view.rendering, name), getattr(expected, name), atol=1e-3, err_msg=name)
    np.testing.assert_array_equal(view.valid, view.rendering.depth > 0)
    assert 0 < view.valid.sum() < view.valid.size
    covered = view.covered
    assert (covered | ~view.valid).all() and covered.sum() > view.valid.sum()
    np.testing.assert_allclose(view.points[covered][:, 2], 2.0, atol=2e-3)  # about where the map begins
    np.testing.assert_array_equal(view.depth > 0, covered)


def test_the_floor_of_a_fit_is_not_drawn_along_the_surface():
    """Four points fitted with a floor, one of no extent, and a covariance that has no floor."""
    normal, floor = np.array([0.6, 0.0, -0.8]), 0.01
    along = np.stack([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0]])
    spread = [(along.T * variances) @ along for variances in ((0.03**2, 0.02**2), (0.0, 0.0))]
    covs = np.stack(
        [*(one + floor**2 * np.eye(3) for one in spread), spread[0] / 100 + 1e-4 * np.outer(normal, normal)]
    )
    rows = np.tile([0.0, 0, 2], (3, 1)), covs, np.zeros((3, 3)), np.tile(normal, (3, 1))
    flat, cut = Gaussians(*map(sc.device, (*rows, np.zeros((3, 0)), np.ones(3, bool)))), sc.on_host(without_floor)
    found = cut(flat, np.float32(floor))
    across = floor**2 * np.outer(normal, normal)
    np.testing.assert_allclose(found.covs[:2], [one + across for one in spread], atol=1e-9)
    np.testing.assert_allclose(np.linalg.eigvalsh(found.covs[2]), [0.0, 0.003**2 - 0.002**2, 1e-4], atol=1e-9)
    same = cut(found, np.float32(0.0))
    np.testing.assert_array_equal(same.covs, found.covs)


def test_a_near_thing_is_drawn_no_wider_than_its_points(densify_config):
    """A board of 20 cm at 1 m before a wall, a pixel being 4 mm; with the floor of 1 cm it is five too wide a side."""
    near = Camera([250.0, 250.0], [59.5, 15.5], 120, 32)
    x, y = (a.reshape(-1) for a in np.meshgrid(np.arange(-0.095, 0.1, 0.01), np.arange(-0.095, 0.1, 0.01)))
    board = sc.flat_gaussians(np.stack([x, y, np.ones_like(x)], -1), (0.005**2 + 0.01**2) ** 0.5, color=1.0)
    map = sc.join(wall(2.0), board)
    wide, narrow = (dense(map, sc.pose(), near, sc.at(densify_config, "min_std", std)).depth[16] for std in (0.0, 0.01))
    assert (int((narrow < 1.5).sum()), int((wide < 1.5).sum())) == (52, 63)


def beside(distance: float, std=0.12) -> Gaussians:
    """A wall that runs along the viewing direction to the right of the camera, from behind it to 2 m before it."""
    z, y = (a.reshape(-1) for a in np.meshgrid(np.arange(-1, 2, std), np.arange(-1.5, 1.5, std)))
    rows = np.stack([np.full(len(z), distance), y, z], -1), np.tile(np.diag([0.02, std, std]) ** 2, (len(z), 1, 1))
    rows += np.tile([0.9, 0.1, 0.1], (len(z), 1)), np.tile([-1.0, 0, 0], (len(z), 1))
    return Gaussians(*map(sc.device, (*rows, np.zeros((len(z), 0)), np.ones(len(z), bool))))


def test_a_door_frame_in_passing_hides_nothing_that_it_does_not_cover(camera, densify_config):
    """The picture that showed it: a frame of a walk in a doorway, filled by a door frame 8 cm before the camera."""
    config = sc.at(densify_config, "render.blur", 0.0)
    alone, passing = (dense(map, sc.pose(), camera, config) for map in (wall(2.0), sc.join(wall(2.0), beside(0.5))))
    column = float(camera.center[0] + camera.focal[0] * 0.5 / 2.0)  # where the wall beside meets the far one
    is_far = alone.valid & (np.arange(camera.width) < column - 4)
    assert is_far.sum() > 100
    np.testing.assert_allclose(passing.depth[is_far], 2.0, atol=0.05)  # its own points are 8 cm wide


def test_the_other_side_of_a_thin_wall_does_not_show_through(camera, densify_config):
    """Seen from the other side it was mapped 3 cm too near to this one."""
    other = sc.replace(wall(1.97, (0.0, 0.0, 1.0)), colors=np.ones(wall(1.97).colors.shape))
    view = dense(sc.join(wall(2.0), other), sc.pose(), camera, densify_config)
    alone = dense(wall(2.0), sc.pose(), camera, densify_config)
    np.testing.assert_allclose(view.colors[alone.valid], alone.colors[alone.valid], atol=1e-5)
    np.testing.assert_allclose(view.depth[alone.valid], alone.depth[alone.valid], atol=1e-5)


def discs(depths, colors, std=0.3) -> Gaussians:
    """Discs that face the camera, behind each other on the ray of pixel (15, 12)."""
    ray = np.array([0.5 / 20.0, -0.25 / 23.0, 1.0])
    return sc.replace(sc.flat_gaussians(np.outer(depths, ray), std, thickness=1e-3), colors=np.array(colors))


RED, BLUE = (0.9, 0.1, 0.1), (0.2, 0.5, 0.8)


@pytest.mark.parametrize("opacity", [0.9, 0.6])
@pytest.mark.parametrize("order", [1, -1])
def test_the_layers_of_a_surface_are_averaged_whichever_comes_first(camera, densify_config, opacity, order):
    """All are centred on the pixel, so each counts the same; what is 7 % behind is another surface."""
    depths, colors = [2.0, 2.02, 2.07, 2.2][::order], [RED, BLUE, BLUE, RED][::order]
    view = dense(discs(depths, colors), sc.pose(), camera, sc.at(densify_config, "render.opacity", opacity))
    np.testing.assert_allclose(view.depth[12, 15], 2.03, atol=1e-4)
    np.testing.assert_allclose(view.colors[12, 15], (np.array(RED) + 2 * np.array(BLUE)) / 3, atol=1e-4)


def test_the_front_of_a_pixel_is_the_weighted_median_of_its_splats(camera, densify_config):
    """Oracle: the splats of some pixels one after the other. Forty of a chunk and more before and behind each other."""
    g = sc.random_gaussians(200, 4, low=(-0.8, -0.6, 1.5), high=(0.8, 0.6, 3))
    g = sc.replace(g, normals=np.tile([0.0, 0.0, -1.0], (200, 1)))
    config = sc.changed(densify_config, **{"render.opacity": 0.3, "surface_depth": 0.1})
    view = dense(g, sc.pose(), camera, config)
    render_config = config.render
    splats = sc.on_host(project_gaussians)(g, sc.pose(), camera, render_config.covariance_scale, render_config.blur)
    order, counts, found = np.argsort(splats.depth), [], []
    for row, column in np.ndindex(24, 32):
        weights, nearness, depths, light = [], [], [], 1.0
        for k in order[splats.valid[order]]:
            offset = np.array([column, row]) - splats.means[k]
            distance_sq = offset @ splats.precisions[k] @ offset
            if distance_sq <= 9.0:
                nearness.append(0.3 * np.exp(-0.5 * distance_sq))
                weights.append(light * nearness[-1])
                light -= weights[-1]
                reach = 3.0 * splats.depth_std[k]
                inverse = splats.inverse_depth[k] + splats.depth_slope[k] @ offset
                depths.append(1 / np.clip(inverse, 1 / (splats.depth[k] + reach), 1 / (splats.depth[k] - reach)))
        counts.append(len(weights))
        if weights:
            weights, nearness, depths = map(np.array, (weights, nearness, depths))
            middle = depths[np.searchsorted(np.cumsum(weights), 0.5 * weights.sum())]
            surface = nearness * (np.abs(depths - middle) <= 0.1 * middle)
            found.append(view.depth[row, column] - (surface @ depths) / surface.sum())
    assert np.max(counts) > 40
    # Where a rounding decides which one is the median, or whether one is within reach, or within 3 σ, it is another.
    assert np.mean(np.abs(found) < 1e-3) > 0.98


def test_pixels_without_depth_are_invalid_and_finite(camera, densify_config):
    nothing = sc.replace(wall(2.0), valid=np.zeros(wall(2.0).valid.shape, bool))
    view = dense(nothing, sc.pose(), camera, densify_config)
    assert not view.valid.any() and not view.covered.any()
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(view))

"""The rasteriser against a tile-free NumPy renderer, and identities that any renderer must satisfy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import reference
import scene as sc
from scipy.spatial.transform import Rotation

from emgs_jax.gaussians import Gaussians
from emgs_jax.render import tiles
from emgs_jax.render.composite import render, splat_depth
from emgs_jax.render.project import Splats

draw = sc.on_host(render)
COUNT = 24  # rows of every map, which makes one program for a size of tiles
T = sc.pose((0.05, -0.1, 0.05), (0.05, -0.05, 0.1))


def scene():
    """Random Gaussians, one of them near and thick, so that it reaches behind the camera, and one seen edge on."""
    g = sc.random_gaussians(COUNT, 2, low=(-0.8, -0.6, 1.5), high=(0.8, 0.6, 3))
    means, covs, normals = (np.array(x) for x in (g.means, g.covs, g.normals))
    means[:2] = (0.25, 0.2, 0.6), (-0.4, 0.3, 1.6)
    covs[0] = np.diag([0.001, 0.001, 0.03])
    normals[:2] = (0.8, 0.0, -0.6), (0.95, 0.2, 0.23)
    return sc.replace(g, means=means, covs=covs, normals=normals)


GAUSSIANS, WHITE = scene(), np.ones((COUNT, 3), np.float32)


@pytest.fixture(scope="module")
def render_config(config):
    return config().refinement.render


def discs(*given) -> Gaussians:
    """Discs of a mean, a normal and a standard deviation, a millimetre thick, and free rows."""
    made = sc.join(*(sc.flat_gaussians(mean, std, normal, 1e-3) for mean, normal, std in given))
    rows = np.arange(COUNT)
    return sc.replace(sc.rows_of(made, np.minimum(rows, len(given) - 1)), valid=rows < len(given))


def assert_images_equal(actual, expected, atol):
    for name in ("values", "alpha", "depth"):
        np.testing.assert_allclose(getattr(actual, name), getattr(expected, name), atol=atol, err_msg=name)


@pytest.fixture(scope="module")
def image(camera, render_config):
    return draw(GAUSSIANS, GAUSSIANS.colors, T, camera, render_config)


def test_the_image_equals_the_tile_free_reference(camera, render_config, image):
    colors = np.asarray(GAUSSIANS.colors, float)
    values, alpha, depth, depth_std = reference.render(
        sc.as_numpy(GAUSSIANS), colors, sc.matrix_of(T), camera, render_config
    )
    assert image.overflow == 0 and (alpha > 0.3).mean() > 0.2
    # A splat's edge (3 σ) has weight .9 exp(-4.5) = .01, and float32 may put a pixel on either side of it.
    wrong = np.abs(image.alpha - alpha) > 1e-4
    assert wrong.mean() < 0.005 and np.abs(image.alpha - alpha).max() < 0.011
    np.testing.assert_allclose(np.asarray(image.values)[~wrong], values[~wrong], atol=1e-4)
    both = ~wrong & (np.abs(alpha - float(render_config.min_alpha)) > 1e-3)
    np.testing.assert_allclose(np.asarray(image.depth)[both], depth[both], atol=2e-3)  # m; slopes in float32
    # The root of a difference of squares of up to 9 m², each known to 1e-6: 3 mm where it is nothing.
    np.testing.assert_allclose(np.asarray(image.depth_std)[both], depth_std[both], atol=5e-3)
    assert np.quantile(depth_std[both], 0.9) > 0.1


def test_depth_exists_exactly_where_alpha_suffices(image, render_config):
    np.testing.assert_array_equal(image.depth > 0, image.alpha >= render_config.min_alpha)
    np.testing.assert_array_equal(image.depth_std > 0, image.alpha >= render_config.min_alpha)


def test_a_gaussian_is_drawn_once_also_where_the_map_has_no_free_row(camera, render_config):
    """The farthest is the last of the order, where the rows of a tile that is not full point."""
    seen, beside = ((0.1, 0.05, 2.0), (0, 0, -1), 0.15), ((9.0, 0.0, 1.0), (0, 0, -1), 0.15)
    alone, among = discs(seen), discs(*[beside] * (COUNT - 1), seen)
    assert among.valid.all()
    images = (draw(gaussians, WHITE, sc.pose(), camera, render_config) for gaussians in (among, alone))
    assert_images_equal(*images, atol=0)


def test_a_steep_plane_is_drawn_no_farther_and_no_nearer_than_its_gaussian_reaches_nor_at_the_camera(render_config):
    """Three standard deviations; of the second, which reaches behind the camera, to a tenth of its depth."""
    depth, std = np.float32([2.0, 4.0, 0.5]), np.float32([0.1, 1.9, 0.02])
    inverse, slope = 1.0 / depth, np.float32([[0.1, 0.0], [0.5, 0.0], [0.0, -0.4]])
    shape = np.zeros((3, 2)), *[np.tile(np.eye(2), (3, 1, 1))] * 2
    pixels = np.stack(np.meshgrid(*[np.arange(-6, 7)] * 2), axis=-1).reshape(-1, 2).astype(np.float32)
    splats = Splats(*(sc.device(x) for x in (*shape, depth, std, inverse, slope, depth > 0, np.ones_like(depth))))
    found = sc.on_host(splat_depth)(splats, pixels, render_config)
    inverse = inverse[:, None] + slope.astype(float) @ pixels.T
    plane = 1.0 / np.where(inverse > 0, inverse, 1e-9)  # beyond its horizon it is infinitely far
    nearest, farthest = np.maximum(depth - 3.0 * std, 0.1 * depth), depth + 3.0 * std
    expected = np.clip(plane, nearest[:, None], farthest[:, None])
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert (expected.min(axis=1) == nearest).all() and (expected.max(axis=1) == farthest).all()


@pytest.fixture
def in_parts(config, monkeypatch):
    """Chunks of four splats, three of them at once: a tile has several, and a look at the lists takes many turns."""
    monkeypatch.setattr(tiles, "CHUNK", 4)
    return config("render.tile_batch=3").refinement.render


@pytest.mark.parametrize("size", [5, 32])
def test_the_image_does_not_depend_on_the_size_of_tiles_and_parts(camera, config, image, size, monkeypatch):
    monkeypatch.setattr(tiles, "CHUNK", {5: 4, 32: 32}[size])
    other = config(f"render.tile_size={size}", f"render.tile_batch={size - 2}").refinement.render
    assert_images_equal(draw(GAUSSIANS, GAUSSIANS.colors, T, camera, other), image, 2e-5)  # order of sums


@sc.on_host
def slopes(changing, gaussians, T_world_camera, weights, camera, config):
    """Of the weighted sum of all images, by the Gaussians' means, covariances and normals, colours and the pose."""

    def total(changing):
        *rows, colors, xi = changing
        g = eqx.tree_at(lambda g: (g.means, g.covs, g.normals), gaussians, rows)
        drawn = render(g, colors, T_world_camera @ jaxlie.SE3.exp(xi), camera, config)
        images = drawn.values, drawn.alpha, drawn.depth, drawn.depth_std
        return sum(jnp.sum(weight * image) for weight, image in zip(weights, images, strict=True))

    return jax.grad(total)(changing)


def inputs(g):
    return g.means, g.covs, g.normals, g.colors, np.zeros(6, np.float32)


def test_the_gradient_of_an_image_is_that_of_the_tile_free_reference(camera, in_parts, image):
    """By each input alone, along a random change of it: differences in float64.

    Splats change places in depth and pixels leave splats in jumps, which have no slope and which no small step meets.
    Depth counts where enough is drawn and its deviation is no rounding.
    """
    rng, step = np.random.default_rng(0), 1e-6
    shape = camera.height, camera.width
    is_deep, is_thick = np.asarray(image.alpha) > 0.4, np.asarray(image.depth_std) > 0.1
    weights = [rng.normal(size=(*shape, 3)), *rng.normal(size=(3, *shape))]
    weights[2:] = weights[2] * is_deep, weights[3] * (is_deep & is_thick)
    given = [np.asarray(x, float) for x in inputs(GAUSSIANS)]
    found = slopes(inputs(GAUSSIANS), GAUSSIANS, T, tuple(map(sc.device, weights)), camera, in_parts)
    for number, name in enumerate(("means", "covs", "normals", "colors", "pose")):
        change = rng.normal(size=given[number].shape)
        if name == "covs":
            change = given[number] * rng.normal(size=(COUNT, 1, 1))  # each as a whole, so that it stays one

        def total(sign, number=number, change=change):
            means, covs, normals, colors, xi = (
                x + sign * step * change if i == number else x for i, x in enumerate(given)
            )
            g, by = sc.as_numpy(GAUSSIANS) | {"means": means, "covs": covs, "normals": normals}, np.eye(4)
            by[:3, :3], by[:3, 3] = Rotation.from_rotvec(xi[3:]).as_matrix(), xi[:3]
            images = reference.render(g, colors, sc.matrix_of(T) @ by, camera, in_parts)
            return sum(np.sum(weight * x) for weight, x in zip(weights, images, strict=True))

        expected = (total(1) - total(-1)) / (2 * step)
        assert np.sum(found[number] * change) == pytest.approx(expected, rel=1e-4), name  # float32: 1e-5 is seen


def test_a_free_row_where_the_camera_is_leaves_every_gradient_finite(camera, in_parts):
    """Free rows are at the origin; a camera there is at depth 0 of them."""
    is_free = np.arange(COUNT) < 4
    free = sc.replace(GAUSSIANS, valid=~is_free, means=np.where(is_free[:, None], 0.0, GAUSSIANS.means))
    ones = tuple(sc.device(np.ones(shape)) for shape in ((24, 32, 3), *[(24, 32)] * 3))
    found = slopes(inputs(free), free, sc.pose(), ones, camera, in_parts)
    assert all(np.isfinite(x).all() for x in found)


MANY = discs(*(((0.0, 0.0, 1.0 + 0.05 * i), (0, 0, -1), 30.0) for i in range(COUNT)))  # each fills the image


@pytest.mark.parametrize(
    ("capacity", "opacity", "overflow"),
    [
        (COUNT, 0.1, 0),
        (COUNT - 1, 0.1, 1),  # behind the others is .09 of the light
        (8, 0.1, 16),  # and here .43
        (8, 0.9, 0),  # 1e-8: nothing that is not drawn would be seen
    ],
)
def test_what_a_full_tile_leaves_out_is_counted_unless_it_is_hidden(camera, config, capacity, opacity, overflow):
    small = sc.at(
        config(f"render.tile_capacity={capacity}", "render.tile_size=32").refinement.render, "opacity", opacity
    )
    drawn = draw(MANY, MANY.colors, sc.pose(), camera, small)
    assert drawn.overflow == overflow
    assert (drawn.alpha > 0.99).all() == (opacity > 0.5)


def test_an_empty_map_is_a_black_image_without_depth(camera, render_config):
    nothing = sc.replace(GAUSSIANS, valid=np.zeros(COUNT, bool))
    rendering = draw(nothing, GAUSSIANS.colors, T, camera, render_config)
    assert all((np.asarray(x) == 0).all() for x in jax.tree.leaves(rendering))


def test_opaque_splats_cover_no_more_than_the_whole_pixel(camera, render_config):
    """Opacity 1 came to 1.0002: each splat behind it added what a bound on its logarithm left."""
    opaque = draw(GAUSSIANS, WHITE, T, camera, sc.at(render_config, "opacity", 1.0))
    assert 0.99 < opaque.alpha.max() <= 1.0

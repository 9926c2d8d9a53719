"""Tile assignment against a box test in NumPy, order by depth, and counted overflow."""

import numpy as np
import pytest
from scene import on_host, pose, random_gaussians, replace

from emgs_jax.render import tiles
from emgs_jax.render.project import project_gaussians

assign_tiles, tile_corners = on_host(tiles.assign_tiles), on_host(tiles.tile_corners)
RADIUS = np.float32(3.0)


@pytest.fixture(scope="module")
def splats(camera):
    g = random_gaussians(60, low=(-1, -0.8, 1), high=(1, 0.8, 3))
    g = replace(g, covs=np.asarray(g.covs) * 0.1, valid=np.arange(60) % 6 > 0)
    return on_host(project_gaussians)(g, pose(), camera, np.float32(1.0), np.float32(0.3))


def touching(splats, corner, size):
    """Rows whose box of 3 standard deviations meets the tile's pixels, nearest first."""
    half = 3 * np.sqrt(np.stack([splats.covs[:, 0, 0], splats.covs[:, 1, 1]], -1))
    low, high = np.asarray(splats.means) - half, np.asarray(splats.means) + half
    rows = np.flatnonzero(((high >= corner) & (low <= corner + size - 1)).all(1) & np.asarray(splats.valid))
    return rows[np.argsort(np.asarray(splats.depth)[rows], kind="stable")]


@pytest.mark.parametrize("size", [8, 7])
def test_the_corners_cover_the_image_row_major(camera, size):
    corners = np.asarray(tile_corners(camera, size))
    expected = [(x, y) for y in range(0, 24, size) for x in range(0, 32, size)]
    np.testing.assert_array_equal(corners, expected)


def test_every_tile_lists_the_splats_that_touch_it_nearest_first(camera, splats):
    corners = tile_corners(camera, 8)
    rows, exists, overflow = assign_tiles(splats, corners, 8, 60, RADIUS)
    assert overflow.sum() == 0
    for tile, corner in enumerate(np.asarray(corners)):
        np.testing.assert_array_equal(np.asarray(rows[tile])[np.asarray(exists[tile])], touching(splats, corner, 8))


def test_a_tile_that_is_too_small_by_one_counts_one_and_keeps_the_nearest(camera, splats):
    corners = tile_corners(camera, 8)
    counts = np.array([len(touching(splats, corner, 8)) for corner in np.asarray(corners)])
    capacity = counts.max() - 1
    rows, exists, overflow = assign_tiles(splats, corners, 8, int(capacity), RADIUS)
    np.testing.assert_array_equal(overflow, np.maximum(counts - capacity, 0))
    fullest = counts.argmax()
    assert overflow[fullest] == 1 and exists[fullest].all()
    np.testing.assert_array_equal(rows[fullest], touching(splats, np.asarray(corners)[fullest], 8)[:-1])

"""The lists of the tiles against a box test in NumPy, order by depth, and counted overflow."""

import numpy as np
import pytest
from scene import device, on_host, pose, random_gaussians, replace

from emgs_jax.render import tiles
from emgs_jax.render.project import project_gaussians

tile_corners = on_host(tiles.tile_corners)
RADIUS = np.float32(3.0)


@pytest.fixture(scope="module")
def splats(camera):
    g = random_gaussians(60, low=(-1, -0.8, 1), high=(1, 0.8, 3))
    g = replace(g, covs=np.asarray(g.covs) * 0.1, valid=np.arange(60) % 6 > 0)
    return on_host(project_gaussians)(g, pose(), camera, np.float32(1.0), np.float32(0.3))


def list_splats(splats, camera, size, capacity, radius):
    return on_host(lambda splats: tiles.list_splats(splats, camera, size, capacity, device(radius)))(splats)


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


def as_lists(found) -> list[np.ndarray]:
    """Rows of every tile."""
    return np.split(found.rows[: found.bounds[-1]], found.bounds[1:-1])


@pytest.mark.parametrize("size", [8, 7])
@pytest.mark.parametrize("word", [2**31, 1])  # a tile and a splat share one word where it holds them
def test_every_tile_lists_the_splats_that_touch_it_nearest_first(camera, splats, size, word, monkeypatch):
    monkeypatch.setattr(tiles, "WORD", word)
    found = list_splats(splats, camera, size, 60, RADIUS)
    corners = np.asarray(tile_corners(camera, size))
    assert (found.overflow == 0).all() and len(as_lists(found)) == len(corners)
    for rows, corner in zip(as_lists(found), corners, strict=True):
        np.testing.assert_array_equal(rows, touching(splats, corner, size))


def test_what_has_no_room_is_counted_by_tile_and_is_the_farthest(camera, splats):
    found = list_splats(splats, camera, 8, 5, RADIUS)
    corners = np.asarray(tile_corners(camera, 8))
    expected = [touching(splats, corner, 8) for corner in corners]
    assert found.bounds[-1] == 5 * len(corners) < sum(map(len, expected))
    for rows, every, missing in zip(as_lists(found), expected, found.overflow, strict=True):
        np.testing.assert_array_equal(rows, every[: len(rows)])
        assert len(every) - len(rows) == missing
    farthest = max(np.asarray(splats.depth)[rows[-1]] for rows in as_lists(found) if len(rows))
    left_out = [every[len(rows) :] for rows, every in zip(as_lists(found), expected, strict=True)]
    assert np.asarray(splats.depth)[np.concatenate(left_out)].min() >= farthest


@pytest.mark.parametrize("count", [1, 4, 100])
def test_chunks_are_the_lists_once_each_and_in_order(camera, splats, count, monkeypatch):
    monkeypatch.setattr(tiles, "CHUNK", 4)
    found = list_splats(splats, camera, 8, 60, RADIUS)
    expected = as_lists(found)
    take = on_host(lambda lists, begin: tiles.take_chunks(lists, begin, count))
    given: list[list[int]] = [[] for _ in expected]
    for begin in range(0, int(found.chunks[-1]), count):
        chunks = take(found, np.int32(begin))
        assert np.isin(chunks.rows, found.rows[: found.bounds[-1]]).all()  # what stands for nothing is a splat, too
        np.testing.assert_array_equal(found.rows[chunks.positions[chunks.exists]], chunks.rows[chunks.exists])
        for tile, rows, exists in zip(chunks.tiles, chunks.rows, chunks.exists, strict=True):
            assert exists.any() == (tile < len(expected))
            if exists.any():
                given[tile] += list(rows[exists])
    for rows, every in zip(given, expected, strict=True):
        np.testing.assert_array_equal(rows, every)

"""The way to a network's grid and back; oracles: upstream's numbers, planes in closed form, the identity."""

import numpy as np
import pytest

from emgs_jax.prior.network.resize import (
    at_pixels,
    choose_grid,
    on_grid_of,
    plan_resize,
    resize_image,
    resize_intrinsics,
)


def frame_on_grid(resize):
    return on_grid_of(resize.frame, resize.scaled, resize.corner)


def to_frame(points, confidence, mask, resize, max_depth_step=0.1):
    return at_pixels(points, confidence, mask, frame_on_grid(resize), max_depth_step)


# What upstream's preprocess_inputs gave: frame, fx, fy, cx, cy, grid, the same on it.
UPSTREAM = {
    "7-Scenes 585": ((640, 480), (585, 585, 320, 240), (518, 392), (477.75, 477.75, 258.9083, 195.9083)),
    "7-Scenes 525": ((640, 480), (525, 525, 320, 240), (518, 392), (428.75, 428.75, 258.9083, 195.9083)),
    "TUM fr1": ((640, 480), (517.3, 516.5, 318.6, 255.3), (518, 392), (422.4617, 421.8083, 257.7650, 208.4033)),
    "TUM fr2": ((640, 480), (520.9, 521.0, 325.1, 249.7), (518, 392), (425.4017, 425.4833, 263.0733, 203.8300)),
    "TUM fr3": ((640, 480), (535.4, 539.2, 320.1, 247.6), (518, 392), (437.2433, 440.3467, 258.9900, 202.1150)),
    "Replica": ((1200, 680), (600, 600, 599.5, 339.5), (518, 294), (259.4118, 259.4118, 258.5, 146.5)),
}


def test_grid_crop_and_intrinsics_are_those_of_the_framework_to_the_last_digit():
    for frame, intrinsics, grid, expected in UPSTREAM.values():
        assert choose_grid(frame) == grid
        matrix = resize_intrinsics(intrinsics, plan_resize(frame, grid))
        assert matrix.dtype == np.float32
        np.testing.assert_allclose(matrix[[0, 1, 0, 1], [0, 1, 2, 2]], expected, atol=6e-5)  # four digits are printed
        np.testing.assert_array_equal(matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1])
    scenes = plan_resize((640, 480), (518, 392))
    assert (scenes.scaled, scenes.corner) == ((522, 392), (2, 0)) and abs(scenes.scale - 0.8166667) < 1e-6
    for aspect in (1.0, 1.33, 1.5, 1.78, 2.0, 3.2, 0.75, 0.65, 0.56, 0.5):
        grid = choose_grid((round(1000 * aspect), 1000))
        assert max(grid) == 518 and grid[0] % 14 == grid[1] % 14 == 0
        assert abs(grid[0] / grid[1] / aspect - 1) < 0.06


def test_a_frame_of_the_grids_size_stays_as_it_is():
    rng = np.random.default_rng(0)
    resize = plan_resize((56, 42), (56, 42))
    image = rng.integers(0, 256, (42, 56, 3), np.uint8)
    np.testing.assert_array_equal(resize_image(image, resize), image)
    np.testing.assert_allclose(
        resize_intrinsics((50, 48, 27.25, 20.5), resize)[[0, 1, 0, 1], [0, 1, 2, 2]], (50, 48, 27.25, 20.5), rtol=1e-6
    )
    points = rng.uniform(1, 2, (42, 56, 3)).astype(np.float32)
    confidence, mask = rng.uniform(1, 5, (42, 56)).astype(np.float32), rng.uniform(size=(42, 56)) < 0.7
    back = to_frame(points, confidence, mask, resize)
    np.testing.assert_array_equal(back[2], mask)
    np.testing.assert_array_equal(back[0][mask], points[mask])
    np.testing.assert_array_equal(back[1][mask], confidence[mask])


@pytest.mark.parametrize("frame", [(640, 480), (200, 110), (30, 90)])
def test_the_image_shows_at_every_grid_pixel_what_the_frame_has_there(frame):
    """A horizontal ramp: its value says where in the frame a grid pixel is."""
    resize = plan_resize(frame, (56, 42))
    ramp = np.linspace(0, 250, frame[0])
    image = np.broadcast_to(ramp[None, :, None], (frame[1], frame[0], 3)).astype(np.uint8)
    columns, rows = frame_on_grid(resize)
    expected = np.interp(np.arange(56), columns, ramp)
    got = resize_image(image, resize)
    assert got.shape == (42, 56, 3) and got.dtype == np.uint8
    # Whole grey levels on both sides and the filter's support at the border.
    np.testing.assert_allclose(got[20, 3:-3, 0], expected[3:-3], atol=2.5)


def plane(shape, intrinsics, normal, distance):
    """Points of the plane n·X = distance at every pixel."""
    v, u = np.indices(shape)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(intrinsics).T
    return (rays * (distance / (rays @ normal))[..., None]).astype(np.float32)


@pytest.mark.parametrize("frame", [(40, 30), (120, 90)])
def test_a_plane_comes_back_as_the_same_plane_on_the_rays_of_the_frames_pixels(frame):
    """Same aspect, so scale and rounded size agree and the rays are exact."""
    resize = plan_resize(frame, (56, 42))
    intrinsics = (0.9 * frame[0], 0.8 * frame[0], 0.47 * frame[0], 0.52 * frame[1])
    normal, distance = np.array([0.3, -0.2, 0.93]), 2.0
    on_grid = plane((42, 56), resize_intrinsics(intrinsics, resize).astype(float), normal, distance)
    K = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1]])
    expected = plane(frame[::-1], K, normal, distance)
    ones = np.ones((42, 56), np.float32)
    points, _, mask = to_frame(on_grid, ones, ones > 0, resize)
    columns, rows = frame_on_grid(resize)
    is_inner = ((rows >= 0) & (rows <= 41))[:, None] & ((columns >= 0) & (columns <= 55))
    assert mask.all() and is_inner.mean() > 0.9
    np.testing.assert_allclose(points[is_inner], expected[is_inner], atol=2e-6)  # float32
    np.testing.assert_allclose(points @ normal, distance, atol=1e-5)  # at the rim the nearest one: on the plane too


def test_beyond_the_crop_the_mask_is_off():
    resize = plan_resize((60, 42), (42, 42))  # 9 columns are cropped on either side
    points = np.ones((42, 42, 3), np.float32)
    got, confidence, mask = to_frame(points, np.full((42, 42), 3, np.float32), np.ones((42, 42), bool), resize)
    assert mask[:, 9:51].all() and not mask[:, :9].any() and not mask[:, 51:].any()
    assert not got[~mask].any() and (confidence[~mask] == 1).all() and (confidence[mask] == 3).all()


def test_nothing_is_interpolated_across_a_depth_edge_or_with_a_masked_pixel():
    resize = plan_resize((120, 90), (56, 42))
    depth = np.where(np.arange(56) < 28, 1.0, 3.0) * np.ones((42, 1))
    points = np.stack([depth, depth, depth], axis=-1).astype(np.float32)
    mask = np.ones((42, 56), bool)
    mask[10:20, 5:15] = False
    points[~mask] = np.nan
    got, _, on = to_frame(points, np.ones((42, 56), np.float32), mask, resize)
    assert set(np.unique(got[on][:, 2].round(5))) == {1.0, 3.0}
    columns, rows = frame_on_grid(resize)
    nearest = mask[np.floor(rows + 0.5).astype(int)[:, None], np.floor(columns + 0.5).astype(int)]
    np.testing.assert_array_equal(on, nearest)

"""A lens with radial distortion: against OpenCV's, its inverse, images of a painted plane, and what is outside."""

import cv2
import numpy as np
from stereo_scene import FOCAL, SIZE, calibration, plane_image, small_lens

from emgs_jax.prior.multiview.lens import as_shown, distort, grid, points_shown, rectify, straight

WIDTH, HEIGHT = SIZE


def test_distorting_is_opencvs_undistortion():
    """OpenCV's k1 distorts what a pinhole sees; ours is the same polynomial the other way."""
    pixels, lens = grid(HEIGHT, WIDTH).reshape(-1, 2), small_lens(-0.2)
    on_plane = ((pixels - lens.center) / lens.focal)[None]
    expected, _ = cv2.projectPoints(
        np.dstack([on_plane, np.ones(on_plane.shape[:2])]).reshape(-1, 3),
        *(np.zeros(3), np.zeros(3), calibration(), np.array([-0.2, 0, 0, 0])),
    )
    np.testing.assert_allclose(straight(pixels, lens), expected[:, 0], atol=1e-9)


def test_distorting_and_straightening_undo_each_other_and_a_pinhole_changes_nothing():
    pixels = grid(HEIGHT, WIDTH)
    for distortion in (-0.2, 0.0, 0.1):
        lens = small_lens(distortion)
        np.testing.assert_allclose(straight(distort(pixels, lens), lens), pixels, atol=0.01)
    gray, depth = plane_image(np.eye(4), 0.4)
    np.testing.assert_array_equal(rectify(gray, small_lens(0.0)), gray)
    both = np.stack([gray, gray[::-1]])
    one_by_one = [rectify(image, small_lens(0.1)) for image in both]
    np.testing.assert_array_equal(rectify(both, small_lens(0.1)), one_by_one)
    np.testing.assert_array_equal(as_shown(depth, small_lens(0.0)), depth)


def test_a_rectified_image_is_what_a_pinhole_sees():
    gray, lens = cv2.GaussianBlur(plane_image(np.eye(4), 0.0)[0], (0, 0), 1.5), small_lens(-0.1)
    x, y = np.moveaxis(np.float32(straight(grid(HEIGHT, WIDTH), lens)), -1, 0)
    shown = cv2.remap(gray, x, y, cv2.INTER_CUBIC)  # what the lens makes of it
    inside = np.s_[8:-8, 8:-8]
    error = np.abs(rectify(shown, lens) - gray)[inside].mean()  # of two interpolations
    assert error < 0.4 * np.abs(shown - gray)[inside].mean()


def test_points_of_shown_depths_lie_on_the_surface_and_beyond_the_pinholes_image_there_are_none():
    _, depth = plane_image(np.eye(4), 0.4)
    lens = small_lens(0.15)  # shows more than the pinhole's image
    points = points_shown(as_shown(depth, lens), lens)
    known = points[..., 2] > 0
    assert not known[0, 0] and not points[~known].any() and known.mean() > 0.8
    # Of the plane z = 2 m + .4 x; the nearest pixel's depth is half a pixel off at most.
    x, _, z = points[known].T
    np.testing.assert_allclose(z, 2.0 + 0.4 * x, atol=0.5 * 0.4 * z.max() / FOCAL[0] * 1.5)

"""The lens of COLMAP's cameras: against pycolmap and OpenCV, its inverse, and a pinhole."""

import cv2
import numpy as np
import pycolmap
import pytest

from emgs_jax.prior.multiview.lens import as_shown, lens_of, points_shown, rectify

PINHOLE, SIZE = (120.0, 118.0, 79.5, 58.0), (160, 120)
GRID = np.stack(np.meshgrid(*map(np.arange, SIZE)), axis=-1).astype(float)


def opencv(factor, *distortion):
    """COLMAP's camera of images so many times as large."""
    values = [factor * 120, factor * 118, factor * 80, factor * 58.5, *distortion]
    return pycolmap.Camera(model="OPENCV", width=int(factor * 160), height=int(factor * 120), params=values)


@pytest.mark.parametrize("factor", [1, 4])
def test_where_a_lens_shows_what_a_pinhole_sees_is_opencvs_projection(factor):
    k = (-0.2, 0.03, 0.001, -0.002)
    lens = lens_of(opencv(factor, *k), PINHOLE, SIZE)
    rays = np.dstack([(GRID - PINHOLE[2:]) / PINHOLE[:2], np.ones(GRID.shape[:2])]).reshape(-1, 3)
    matrix = np.array([[120.0, 0, 79.5], [0, 118, 58], [0, 0, 1]])
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(k))
    np.testing.assert_allclose(lens.shown.reshape(-1, 2), expected[:, 0], atol=1e-3)
    inside = lens.straight[20:-20, 20:-20]
    back = cv2.remap(lens.shown, np.float32(inside), None, cv2.INTER_LINEAR)
    np.testing.assert_allclose(back, GRID[20:-20, 20:-20], atol=0.02)
    image = np.zeros((120, 160), np.float32)
    assert rectify(image, lens).shape == image.shape and np.abs(lens.shown - GRID).max() > 2


def test_a_pinhole_changes_nothing():
    lens, values = (
        lens_of(opencv(4, 0, 0, 0, 0), PINHOLE, SIZE),
        np.random.default_rng(0).random((120, 160), np.float32),
    )
    assert rectify(values, lens) is values and as_shown(values, lens) is values
    points = points_shown(values, lens)
    np.testing.assert_allclose(points[..., :2], values[..., None] * (GRID - PINHOLE[2:]) / PINHOLE[:2], atol=1e-6)

"""Intrinsics that are not those of the images: what is said of them, and what they are taken to be."""

import cv2
import numpy as np
import pytest

from emgs_jax.data.calibration_files import Calibration
from emgs_jax.data.images import Images
from emgs_jax.data.intrinsics import check_plausible
from emgs_jax.data.plausible_camera import is_impossible, oddities, other_reading, view_deg

SIZE, TRUE = (1920, 1080), (1500.0, 1510.0, 950.0, 545.0)
REAL = {  # published calibrations, with the size of their images
    "TUM fr1": ((517.3, 516.5, 318.6, 255.3), (640, 480)),
    "EuRoC cam1": ((457.6, 456.1, 380.0, 255.2), (752, 480)),
    "KITTI 00": ((718.856, 718.856, 607.1928, 185.2157), (1241, 376)),
    "ScanNet": ((1170.2, 1170.2, 647.8, 483.8), (1296, 968)),
    "Replica": ((600.0, 600.0, 599.5, 339.5), (1200, 680)),
    "a phone's telephoto": ((4200.0, 4200.0, 959.5, 539.5), (1920, 1080)),
}


@pytest.mark.parametrize("camera", REAL.values(), ids=REAL)
def test_nothing_is_odd_about_real_cameras_nor_about_them_at_another_size(camera):
    values, size = camera
    assert oddities(values, size) == []
    assert oddities(tuple(v / 3 for v in values), (size[0] // 3, size[1] // 3)) == []
    assert check_plausible(Calibration(values), size, "dataset.intrinsics", "images") is None


def test_the_angle_of_view_is_that_of_the_ray_through_the_border():
    width, height = view_deg((960.0, 540.0 / np.tan(np.radians(30)), 0.0, 0.0), SIZE)
    assert width == pytest.approx(90) and height == pytest.approx(60)


def test_one_direction_that_no_lens_has_is_enough():
    assert not is_impossible(TRUE, SIZE)
    for odd in (20.0, 1e6):  # a view of half a turn, and of a hundredth of a degree
        assert is_impossible((odd, *TRUE[1:]), SIZE) and is_impossible((TRUE[0], odd, *TRUE[2:]), SIZE)


def slips(fx, fy, cx, cy):
    """The same camera, as people give it by mistake."""
    (w, h), (u, v) = SIZE, (cx + 0.5, cy + 0.5)
    yield "normalised by width and height", (fx / w, fy / h, u / w, v / h)
    yield "normalised by the width", (fx / w, fy / w, u / w, v / w)
    yield "in the order fx, cx, fy, cy", (fx, cx, fy, cy)
    yield "with cx and cy exchanged", (fx, fy, cy, cx)
    for scale in (1 / 6, 1 / 3, 1 / 2, 2 / 3, 5 / 6):
        yield (
            f"of images of {SIZE[0] * scale:.0f}x{SIZE[1] * scale:.0f}",
            (fx * scale, fy * scale, u * scale - 0.5, v * scale - 0.5),
        )


@pytest.mark.parametrize("camera", [(1500.0, 1500.0, 959.5, 539.5), TRUE])
def test_a_slip_is_refused_with_what_it_is_and_the_numbers_to_give(camera):
    """Where the principal point is not in the middle, the other images' size is known about as well."""
    for name, given in slips(*camera):
        reading = other_reading(given, SIZE)
        is_exact = camera != TRUE or "of images of" not in name
        assert reading is not None and (name if is_exact else "of images of") in reading
        numbers = [float(word) for word in reading[reading.index("[") + 1 : -1].split(",")]
        np.testing.assert_allclose(numbers, camera, rtol=1e-5 if is_exact else 0.02)
        with pytest.raises(
            ValueError, match=r"dataset.intrinsics .* is odd for the 1920x1080 images: .*they fit as those"
        ):
            check_plausible(Calibration(given), SIZE, "dataset.intrinsics", "images")


@pytest.mark.parametrize(
    "given, says",
    [
        ((4.2, 4.2, 2.8, 2.1), "the view is 179 degrees wide"),  # millimetres of the sensor
        ((26.0, 26.0, 959.5, 539.5), "the view is 177 degrees wide"),  # mm of 35 mm film
        ((1e7, 1e7, 959.5, 539.5), "the view is 0.011 degrees wide"),  # metres
    ],
)
def test_a_view_that_no_lens_has_is_refused_and_says_what_is_meant(given, says):
    assert is_impossible(given, SIZE)
    for size in (None, SIZE):
        with pytest.raises(ValueError, match=f"{says}.*give fx, fy, cx, cy in pixels of the images on disk"):
            check_plausible(Calibration(given, (), size), SIZE, "dataset.intrinsics", "images")


@pytest.mark.parametrize(
    "given, says",
    [
        ((1500.0, 1500.0, 700.0, 539.5), "the principal point is 14 % of the width from the middle; check it"),
        ((1500.0, 844.0, 959.5, 539.5), r"pixels would not be square \(fx / fy = 1.78\); check it"),  # squeezed
        ((13000.0, 13000.0, 959.5, 539.5), "the view is 8.45 degrees wide, the view is 4.76 degrees high; check it"),
    ],
)
def test_what_is_rare_is_taken_and_said(given, says):
    with pytest.raises(AssertionError, match=says):  # a regular expression that pytest shows
        raise AssertionError(check_plausible(Calibration(given), SIZE, "dataset.intrinsics", "images"))


def test_a_driver_whose_calibration_is_of_another_resolution_is_told_of_in_the_note(tmp_path):
    """A file that says the size is believed: a crop of the upper left corner has such a camera."""
    folder, path = tmp_path / "images", tmp_path / "camera.yaml"
    folder.mkdir()
    cv2.imwrite(str(folder / "0.png"), np.zeros((108, 192, 3), np.uint8))
    path.write_text("{width: 192, height: 108, calibration: [50, 50, 31.5, 17.5]}")
    note = Images(str(folder), intrinsics=str(path)).calibration["note"]
    assert "camera.yaml" in note and "33 % of the width" in note and "they fit as those of images of 64x36" in note

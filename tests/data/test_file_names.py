"""Times in the names of images; oracle: the times from which the names were written."""

from pathlib import Path
from unittest.mock import ANY

import numpy as np
import pytest
from PIL import Image

from emgs_jax.data.file_names import natural_order, taken_note, times_of
from emgs_jax.data.timestamps import in_seconds, nearest_rows, resolution, unit_of
from emgs_jax.data.tum import read_list
from emgs_jax.evaluation.trajectory import associate
from emgs_jax.io.trajectory import load_trajectory_tum

START = 1403636579763555584  # EuRoC's first image, nanoseconds since 1970
STEP_MS = 50


def found(names) -> tuple[np.ndarray, str | None]:
    times, note = times_of([Path("a") / f"{name}.png" for name in names])
    return np.array(times), note


@pytest.mark.parametrize("unit, digits", [("nanoseconds", 0), ("microseconds", 3), ("milliseconds", 6)])
@pytest.mark.parametrize("begin", ["", "cam0_"])
def test_names_that_count_from_1970_in_any_unit_are_seconds(unit, digits, begin):
    names = [f"{begin}{(START + i * STEP_MS * 10**6) // 10**digits}" for i in range(4)]
    times, note = found(names)
    np.testing.assert_allclose(times, START / 1e9 + np.arange(4) * STEP_MS / 1000, atol=1e-3 if digits == 6 else 1e-6)
    assert note == f"times are the names of the images, in {unit}"


def test_names_that_count_from_a_boot_are_known_by_their_steps_and_frame_numbers_stay_numbers():
    assert found([84_236_748_123_456 + 33_333_333 * i for i in range(3)])[0] == pytest.approx(
        84236.748123456 + np.arange(3) / 30, abs=1e-6
    )
    assert np.diff(found([500 + 33_333 * i for i in range(3)])[0]) == pytest.approx(1 / 30, abs=1e-5)
    assert np.diff(found([84_236_748_123 + 8_333 * i for i in range(3)])[0]) == pytest.approx(1 / 120, abs=1e-5)
    assert found([84_236_748 + 33 * i for i in range(3)]) == (pytest.approx([84236.748, 84236.781, 84236.814]), ANY)
    for names in (["2", "10", "33"], ["f-000000", "f-001000"], ["1305031102.175304", "1305031102.211214"], ["7"]):
        times, note = found(names)
        assert note is None and times == pytest.approx([float(name.removeprefix("f-")) for name in names], abs=1e-9)


@pytest.mark.parametrize(
    ("names", "is_decimal"),
    [
        (["102.9", "102.93", "103", "103.03", "103.1"], True),  # as Python prints seconds; 103.1 came before 103.03
        (["a_0.9", "a_0.95", "a_1.0", "a_1.05", "a_1.1"], True),
        (["102.90", "102.93", "103.00", "103.05"], False),  # as they stand
        (["1.8", "1.9", "1.10", "1.11"], False),  # a counter after a point
        (["v1.2.9", "v1.2.10", "v1.2.111"], False),
        (["frame2", "frame10", "frame10b"], False),
    ],
)
def test_seconds_whose_last_zeros_are_left_out_are_in_order_of_their_value(names, is_decimal):
    paths = [Path("a") / f"{name}.png" for name in sorted(names)]
    order, note = natural_order(paths)
    assert [paths[row].stem for row in order] == names and bool(note) == is_decimal
    if is_decimal:
        assert found(names)[0] == pytest.approx([float(name.removeprefix("a_")) for name in names], abs=1e-9)


@pytest.mark.parametrize(
    "names",
    [
        ["20260711_101559.jpg", "20260711_101559(0).jpg", "20260711_101559(1).jpg", "20260711_101600.jpg"],
        ["IMG_7.jpg", "IMG_7-1.jpg", "IMG_7-2.jpg", "IMG_10.jpg"],
        ["a.png", "a (1).png", "a (2).png", "a (10).png"],
    ],
)
def test_the_first_image_of_a_burst_has_no_number_and_comes_first(names):
    """Symptom: `…59(0).jpg` came before `…59.jpg`, as a parenthesis sorts before a point."""
    order, _ = natural_order([Path("a") / name for name in sorted(names)])
    assert [sorted(names)[row] for row in order] == names


def test_times_in_names_that_go_back_are_told_and_other_numbers_are_not():
    times, note = found(["1_1305031102.5", "2_1305031050.5", "3_1305031103.5"])
    assert times.tolist() == [0, 1, 2] and "go back from 1_1305031102.5.png to 2_1305031050.5.png" in note
    assert "go back" in found(["a_20261127_142259", "b_20261127_132301"])[1]
    assert found(["a_7", "b_5"])[1] is None


def test_images_that_were_taken_in_another_order_than_their_names_have_are_told(tmp_path):
    """After IMG_9999 a camera begins anew with IMG_0001, and a walk began with its end."""
    paths = [tmp_path / f"IMG_{number:04d}.jpg" for number in (1, 2, 9998, 9999)]
    for path, second in zip(paths, (12, 13, 10, 11), strict=True):
        exif = (image := Image.new("RGB", (8, 8))).getexif()
        exif.get_ifd(0x8769)[0x9003] = f"2026:11:27 14:22:{second}"
        image.save(path, exif=exif)
    assert taken_note(paths).startswith("IMG_9998.jpg comes after IMG_0002.jpg by its name, but was taken before it")
    assert taken_note([*paths[2:], *paths[:2]]) is None
    Image.new("RGB", (8, 8)).save(paths[0])
    assert taken_note(paths[:1]) is None


def test_seconds_and_nanoseconds_side_by_side_and_dates_are_seconds():
    assert np.diff(found(["1403636579_763555584", "1403636580_013555584"])[0]) == pytest.approx(0.25, abs=1e-6)
    for names in (["20261127_142259", "20261127_142259"], ["20261327_142259", "20261327_142259"], ["a", "b"]):
        assert found(names)[0].tolist() == [0, 1] and found(names)[1] is None


def test_lists_and_trajectories_in_nanoseconds_fit_those_in_seconds(tmp_path):
    """ORB-SLAM3 wrote nanoseconds into TUM's format, and nothing matched."""
    times, pose = [START + i * 50_000_000 for i in range(3)], "0.1 0 0 0 0 0 1"
    path = tmp_path / "t.txt"
    path.write_text("".join(f"{time} {pose}\n" for time in times))
    seconds = np.array(times) / 1e9
    for read in (in_seconds(load_trajectory_tum(path)[0]), read_list(path, 8)[0]):
        np.testing.assert_allclose(read, seconds, atol=1e-6)
        assert associate(read, seconds, 1e-3)[0].tolist() == [0, 1, 2]
        assert nearest_rows(read, seconds, 0.0) == [0, 1, 2]  # below what float64 tells apart


def test_a_difference_that_is_the_tolerance_is_within_it_however_floats_round():
    times = 1305031102.0 + np.arange(3)
    late = times + 0.02  # 0.01999998 or 0.02000022 in float64
    assert associate(times, late, 0.02)[0].tolist() == [0, 1, 2] == nearest_rows(times, late, 0.02)
    assert associate(times, late, 0.0199)[0].tolist() == [] and nearest_rows(times, late, 0.0199) == [-1] * 3
    assert resolution(times) < 1e-6 and resolution(np.empty(0)) < 1e-300


def test_no_number_is_a_time_in_two_units():
    for unit, per_second in (("seconds", 1), ("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
        for second in (1.0e9, 1.7e9, 4.2e9):
            assert unit_of(np.array([second, second]) * per_second) == unit
    assert in_seconds(np.empty(0)).shape == (0,) and unit_of(np.array([5.0])) == "seconds"

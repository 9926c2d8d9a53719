"""Folders of images and videos."""

from fractions import Fraction
from unittest import mock

import cv2
import numpy as np
import pytest
from written_scene import color_image

from emgs_jax.data.base import BadFrameError
from emgs_jax.data.images import Images
from emgs_jax.data.video import _times

INTRINSICS = (128.0, 128.0, 79.5, 59.5)
SIZE = (160, 120)


def load(path, **options):
    return Images(str(path), **{"size": SIZE, "intrinsics": INTRINSICS, **options})


def number_of(frame) -> int:
    """Which color_image a frame is, by its red."""
    return round((frame.image[..., 0].mean() - 20) / 40)


def write_video(path, num_frames: int = 6) -> None:
    code = {".avi": "MJPG", ".mp4": "mp4v"}[path.suffix]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), 25.0, SIZE)
    if not writer.isOpened():
        pytest.skip(f"this OpenCV cannot write {path.suffix}")
    for i in range(num_frames):
        writer.write(color_image(i, SIZE))
    writer.release()


def test_images_come_in_the_order_of_their_numbers_in_any_case(images_root):
    dataset = load(images_root)
    assert [number_of(frame) for frame in dataset] == [0, 1, 2]
    assert [frame.timestamp for frame in dataset] == [2, 10, 33]
    assert not dataset.has_ground_truth
    assert dataset[0].depth is None and dataset[0].T_world_camera is None
    np.testing.assert_allclose(dataset.intrinsics, INTRINSICS)


def test_names_without_ascending_numbers_get_their_position_as_time(images_root):
    (images_root / "img10.JPG").rename(images_root / "imgx.JPG")
    assert [frame.timestamp for frame in load(images_root)] == [0, 1, 2]
    assert len(load(images_root, stop=1)) == 1
    np.testing.assert_allclose(load(images_root, size=(80, 30)).intrinsics, (64, 32, 39.5, 14.5))  # another aspect


def test_a_broken_first_image_and_one_of_another_size_are_bad_frames_and_hide_no_other(images_root):
    (images_root / "img2.png").write_bytes(b"")
    cv2.imwrite(str(images_root / "img44.png"), color_image(0, (80, 60)))
    dataset = load(images_root)
    for index, message in ((0, "img2.png is empty"), (3, "img44.png is 80x60")):
        with pytest.raises(BadFrameError, match=message):
            dataset[index]
    assert number_of(dataset[1]) == 1


def test_pictures_that_are_not_read_are_named(images_root):
    """A phone's folder with three JPEGs among its HEICs was a sequence of three images, without a word."""
    (images_root / "IMG_1.HEIC").write_bytes(b"")
    assert "has 1 .heic, which are not read: convert" in load(images_root).calibration["note"]


@pytest.mark.parametrize("second", ["{}_mask.png", "{}.depth.png", "{}.jpg", "right_{}.png"])
def test_two_images_of_each_number_are_no_sequence(second, tmp_path):
    """Masks and depths beside images were every second frame of the walk."""
    first = "left_{}.png" if "right" in second else "{}.png"
    for number in ("003", "004", "005"):
        for name in (first, second):
            cv2.imwrite(str(tmp_path / name.format(number)), color_image(0, SIZE))
    if "right" in second:  # as two clips, one after the other
        assert len(load(tmp_path)) == 6
    else:
        with pytest.raises(ValueError, match=r"2 kinds that have the same numbers, such as 003\S+ and 003\S+: a seq"):
            load(tmp_path)


def test_names_whose_numbers_say_little_are_one_sequence(tmp_path):
    for name in ("hall1_a", "hall1_b", "hall1_c", "hall1_d", "hall2_a"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), color_image(0, SIZE))
    assert len(load(tmp_path)) == 5


@pytest.mark.parametrize("suffix", [".webp", ".tif"])
def test_formats_of_the_web_and_of_science_are_read(suffix, tmp_path):
    """No image of a folder of float TIFFs could be read, "fetch them again"."""
    for i in range(2):
        image = color_image(i, SIZE)
        cv2.imwrite(str(tmp_path / f"{i}{suffix}"), np.float32(image) / 255 if suffix == ".tif" else image)
    dataset = load(tmp_path)
    assert len(dataset) == 2 and dataset[0].image.max() > 100


def test_what_is_transparent_in_images_is_said(tmp_path):
    image = np.dstack([color_image(0, SIZE), np.full(SIZE[::-1], 255, np.uint8)])
    cv2.imwrite(str(tmp_path / "0.png"), image)
    assert "note" not in load(tmp_path).calibration
    image[:5, :, 3] = 0
    cv2.imwrite(str(tmp_path / "0.png"), image)
    assert "0.png is transparent in places" in load(tmp_path).calibration["note"]


@pytest.mark.parametrize("suffix", [".avi", ".mp4"])
def test_a_video_gives_the_right_frame_in_any_order(suffix, tmp_path):
    path = tmp_path / f"clip{suffix}"
    write_video(path)
    dataset = load(path, stride=2)
    assert len(dataset) == 3
    for i in (0, 1, 2, 1, 0, 2, 2):
        frame = dataset[i]
        assert number_of(frame) == 2 * i and frame.name == f"{path}, frame {2 * i}"
        assert frame.timestamp == pytest.approx(2 * i / 25)


def turn_in_its_metadata(path) -> None:
    """Say in the track's header that a player must turn the picture by 90 degrees clockwise, as a phone does.

    The matrix of tkhd (ISO 14496-12, 8.3.2) sends (x, y) to (a x + c y, b x + d y): right becomes down.
    """
    content, unit = path.read_bytes(), (1 << 16).to_bytes(4, "big")
    minus, end = (-(1 << 16)).to_bytes(4, "big", signed=True), (1 << 30).to_bytes(4, "big")
    zero = bytes(4)
    straight = unit + zero * 3 + unit + zero * 3 + end
    place = content.index(straight, content.index(b"tkhd"))
    turned = zero + unit + zero + minus + zero * 4 + end
    path.write_bytes(content[:place] + turned + content[place + len(turned) :])


def test_a_video_of_a_phone_that_was_held_upright_comes_upright(tmp_path):
    path = tmp_path / "clip.mp4"
    write_video(path)
    lying = load(path)[3].image
    turn_in_its_metadata(path)
    size = SIZE[::-1]
    upright = load(path, size=size, intrinsics=(128.0, 128.0, 59.5, 79.5))
    assert upright.intrinsics == (128.0, 128.0, 59.5, 79.5) and upright.size == size
    for i in (3, 1):  # backwards: the video is opened again
        assert upright[i].image.shape == (size[1], size[0], 3) and number_of(upright[i]) == i
    np.testing.assert_array_equal(upright[3].image, np.rot90(lying, -1))


def test_a_video_has_the_frames_that_can_be_read_whatever_its_header_announces(tmp_path):
    path = tmp_path / "clip.avi"
    write_video(path)
    content = path.read_bytes()
    # Two more images than there are, in the main header and in that of the stream: as after a cut.
    count = (6).to_bytes(4, "little")
    at = [content.index(b"avih") + 8 + 16, content.index(b"strh") + 8 + 32]
    assert all(content[place : place + 4] == count for place in at)
    for place in at:
        content = content[:place] + (8).to_bytes(4, "little") + content[place + 4 :]
    path.write_bytes(content)
    dataset = load(path)
    assert [number_of(frame) for frame in dataset] == [0, 1, 2, 3, 4, 5]
    assert "clip.avi announces 8 frames, 6 can be read" in dataset.calibration["note"]
    assert "note" not in load(path, stop=6).calibration and len(load(path, stop=4)) == 4
    with pytest.raises(ValueError, match=r"dataset.stop must be null \(all\) or in 1..6"):
        load(path, stop=7)
    with pytest.raises(ValueError, match=r"dataset.start must be in 0..5"):
        load(path, start=6, stop=3)


def test_a_video_whose_rate_changes_has_all_its_frames_at_the_times_that_the_file_says(tmp_path):
    """Matroska has no count in its header; OpenCV answers duration x nominal rate (here 6 of 9), and one mean rate."""
    av = pytest.importorskip("av")
    path, times = tmp_path / "clip.mkv", [0, 67, 134, 201, 221, 241, 261, 281, 301]
    with av.open(str(path), "w") as out:
        stream = out.add_stream("mpeg4", rate=15)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for i, time in enumerate(times):
            frame = av.VideoFrame.from_ndarray(color_image(i % 6, SIZE), format="bgr24")
            frame.pts, frame.time_base = time, Fraction(1, 1000)
            out.mux(stream.encode(frame))
        out.mux(stream.encode())
    assert cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT) < len(times)
    dataset = load(path)
    assert [number_of(frame) for frame in dataset] == [i % 6 for i in range(9)]
    np.testing.assert_allclose([frame.timestamp for frame in dataset], np.array(times) / 1000, atol=1e-6)


def test_a_video_of_oblong_pixels_is_shown_as_players_show_it(tmp_path):
    """PAL and anamorphic recordings; one focal length was estimated for both directions of what is squeezed."""
    av = pytest.importorskip("av")
    path = tmp_path / "clip.mp4"
    with av.open(str(path), "w") as out:
        stream = out.add_stream("mpeg4", rate=15)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        for i in range(3):
            out.mux(stream.encode(av.VideoFrame.from_ndarray(color_image(i, SIZE), format="bgr24")))
        out.mux(stream.encode())
    dataset = load(path, size=(213, 120), intrinsics=(128.0, 128.0, 106.0, 59.5))
    assert [number_of(frame) for frame in dataset] == [0, 1, 2] and dataset.full(0).shape == (120, 213, 3)
    assert "are shown as 213x120" in dataset.calibration["note"]


class StreamWithoutTimes:
    """A capture of a bare h264 stream: three frames, all of them at 0."""

    left = 3

    def grab(self):
        self.left -= 1
        return self.left >= 0

    def get(self, what):
        return {cv2.CAP_PROP_POS_MSEC: 0.0, cv2.CAP_PROP_FPS: 25.0}[what]


def test_a_stream_without_times_has_those_of_its_nominal_rate():
    assert _times(StreamWithoutTimes(), None) == [0.0, 1 / 25, 2 / 25]


def test_a_video_that_is_not_whole_is_to_be_copied_again_and_not_converted(tmp_path):
    path = tmp_path / "clip.mp4"
    write_video(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(0.66 * len(whole))])
    with pytest.raises(ValueError, match="clip.mp4 is not whole, the recording or the copy was cut off: copy it again"):
        load(path)


@pytest.mark.parametrize("grabs", [True, False])
def test_a_video_of_which_nothing_is_decoded_names_its_codec_and_the_program_that_converts_it(grabs, tmp_path):
    """AV1: the header is read, and no frame; the advice was dataset.stop=0, which is refused."""
    path = tmp_path / "clip.mp4"
    write_video(path)
    opened = mock.Mock(**{"isOpened.return_value": True, "read.return_value": (False, None)})
    opened.grab.side_effect = [grabs] * 3 + [False] * 9
    opened.get.side_effect = lambda key: float(cv2.VideoWriter_fourcc(*"av01")) if key == cv2.CAP_PROP_FOURCC else 3.0
    with mock.patch("cv2.VideoCapture", return_value=opened), pytest.raises(ValueError, match=r"av01.*h264 \(ffmpeg"):
        load(path)

"""Lists of checksums; oracle: `sha256sum` itself, and bytes that are changed."""

import hashlib
import subprocess

import numpy as np
import pytest
from test_layouts import ON_DISK, load

from emgs_jax.data.base import BadFrameError
from emgs_jax.data.checksums import SUMS_FILE, WRITE, Checksums, read_sums
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.data.synthetic import Synthetic

CHANGED = {
    "seven_scenes": "kitchen/seq-01/frame-000001.color.jpg",
    "tum": "rgbd_dataset_freiburg3_plane/groundtruth.txt",
    "replica": "office9/results/frame000001.jpg",
    "images": "img10.JPG",
}


def flip(path):
    """Change bytes inside of what a JPEG draws; anywhere else a digit for another."""
    data = bytearray(path.read_bytes())
    if path.suffix.lower() == ".jpg":
        place = len(data) // 2
        data[place : place + 8] = bytes(byte ^ 0x55 if byte not in (0xFF, 0xAA) else byte for byte in data[place:][:8])
    else:
        data = data.replace(b"0", b"1", 1)
    path.write_bytes(data)


def write_list(folder):
    """As the messages and the README say."""
    subprocess.run(WRITE.replace("FOLDER", f"'{folder}'"), shell=True, check=True)


def sequence_folder(root, name):
    return root / ON_DISK[name][1]


@pytest.mark.parametrize("name", ON_DISK)
def test_a_sound_sequence_passes_and_a_changed_file_is_named_with_the_remedy(name, request):
    root = request.getfixturevalue(f"{name}_root")
    write_list(sequence_folder(root, name))
    frames = ReadableFrames(load(name, root), checksums="auto")
    images = [frame.image for frame in frames]
    for image, expected in zip(images, ReadableFrames(load(name, root)), strict=True):
        np.testing.assert_array_equal(image, expected.image)
    path = root / CHANGED[name]
    flip(path)
    with pytest.raises(BadFrameError) as caught:
        list(frames)  # the very same object: what it has found sound was another file
    message = str(caught.value)
    assert f"{path} is not the file of {sequence_folder(root, name) / SUMS_FILE}, line " in message
    assert "on_bad_frame=skip" in message and "sha256sum" in message


def test_without_a_list_flipped_bytes_of_a_jpeg_are_a_picture_like_any_other(images_root):
    root = images_root
    before = [frame.image for frame in ReadableFrames(load("images", root), checksums="auto")]
    flip(root / CHANGED["images"])
    after = [frame.image for frame in ReadableFrames(load("images", root), checksums="auto")]
    assert sum(not np.array_equal(one, other) for one, other in zip(before, after, strict=True)) == 1


def test_a_changed_frame_is_left_out_where_bad_ones_are_skipped(images_root):
    root = images_root
    write_list(root)
    whole = len(load("images", root))
    flip(root / CHANGED["images"])
    frames = ReadableFrames(load("images", root), "skip", "auto")
    assert len(frames) == whole - 1 and len(frames.skipped) == 1
    assert CHANGED["images"] in next(iter(frames.skipped.values()))
    assert len(ReadableFrames(load("images", root), "skip", "off")) == whole


def test_a_list_above_the_images_or_given_by_name_is_taken_and_others_are_not(images_root):
    root = images_root
    sub = root / "a" / "b"
    sub.mkdir(parents=True)
    for path in [path for path in root.iterdir() if path.is_file()]:
        path.rename(sub / path.name)
    write_list(root)
    flip(sub / CHANGED["images"])
    too_far = ReadableFrames(load("images", sub), checksums="auto")
    assert len(list(too_far)) == len(too_far), "two folders above"
    elsewhere = root / "link"
    elsewhere.symlink_to(root)
    for given in (root / SUMS_FILE, elsewhere / SUMS_FILE):
        with pytest.raises(BadFrameError, match="is not the file of"):
            list(ReadableFrames(load("images", sub), checksums=str(given)))
    (root / SUMS_FILE).rename(root / "a" / SUMS_FILE)  # its names do not fit there
    with pytest.raises(ValueError, match=r"lacks \d+ of the \d+ images in use, first of all .*checksums=off"):
        ReadableFrames(load("images", sub), checksums="auto")


def test_an_image_that_is_not_listed_is_an_error_and_a_missing_one_is_called_missing(replica_root):
    root = replica_root
    write_list(root / "office9")
    path = root / "office9" / SUMS_FILE
    text = path.read_text()
    lines = text.splitlines(keepends=True)
    path.write_text("".join(line for line in lines if "frame000001" not in line))
    with pytest.raises(ValueError, match=r"lacks 1 of the \d+ images in use, first of all .*frame000001\.jpg"):
        ReadableFrames(load("replica", root), checksums="auto")
    path.write_text("".join(line for line in lines if "depth" not in line and "traj" not in line))
    assert list(ReadableFrames(load("replica", root), checksums="auto")), "depth need not be listed"
    path.write_text(text)
    frames = ReadableFrames(load("replica", root), checksums="auto")
    (root / "office9" / "results" / "depth000001.png").unlink()
    with pytest.raises(BadFrameError, match=r"depth000001\.png is missing"):
        list(frames)


@pytest.mark.parametrize("name", ["plain.jpg", "two  spaces.jpg", "new\nline.jpg", "back\\slash.jpg", "ä.jpg", " x"])
@pytest.mark.parametrize("option", ["--text", "--binary"])
def test_names_are_read_as_sha256sum_writes_them(name, option, tmp_path):
    (tmp_path / name).write_bytes(b"1")
    written = subprocess.run(["sha256sum", option, name], cwd=tmp_path, capture_output=True, check=True).stdout
    for text in (written, written.replace(b"\n", b"\r\n"), b"\xef\xbb\xbf" + written + b"\n"):
        (tmp_path / SUMS_FILE).write_bytes(text)
        assert read_sums(tmp_path / SUMS_FILE) == {tmp_path / name: (1, hashlib.sha256(b"1").hexdigest())}
    sums = Checksums(tmp_path / SUMS_FILE)
    sums.check(tmp_path / name)
    (tmp_path / name).write_bytes(b"2")
    with pytest.raises(BadFrameError):
        sums.check(tmp_path / name)


@pytest.mark.parametrize(
    "line", ["abc  a.jpg", "g" * 64 + "  a.jpg", "0" * 63 + "  a.jpg", "0" * 64, "0" * 64 + "  ", "0" * 64 + "  \0"]
)
def test_a_line_that_is_none_is_named_with_its_number(line, tmp_path):
    (tmp_path / SUMS_FILE).write_text(f"{'0' * 64}  b.jpg\n{line}\n")
    with pytest.raises(ValueError, match=rf"{SUMS_FILE}, line 2: expected 64 hexadecimal digits.*sha256sum"):
        read_sums(tmp_path / SUMS_FILE)


def test_a_list_that_is_not_there_is_an_error_where_it_is_named(images_root):
    with pytest.raises(ValueError, match=r"checksums=.*gone cannot be read: give the file, auto or off"):
        ReadableFrames(load("images", images_root), checksums=str(images_root / "gone"))


def test_frames_that_are_made_have_no_files():
    assert len(ReadableFrames(Synthetic(size=(8, 6), num_frames=40, stop=2), checksums="auto")) == 2

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
    "bonn": "rgbd_dataset_freiburg3_plane/groundtruth.txt",
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


def images_of(frames):
    return [frame.image for frame in frames]


@pytest.mark.parametrize("name", ON_DISK)
def test_a_sound_sequence_passes_and_a_changed_file_is_named_with_the_remedy(name, request):
    root = request.getfixturevalue(f"{name}_root")
    folder, path = root / ON_DISK[name][1], root / CHANGED[name]
    before = images_of(ReadableFrames(load(name, root), checksums="auto"))
    write_list(folder)
    frames = ReadableFrames(load(name, root), checksums="auto")
    for image, expected in zip(images_of(frames), before, strict=True):
        np.testing.assert_array_equal(image, expected)
    flip(path)
    for image, expected in zip(images_of(frames), before, strict=True):  # a run goes on with what it has found sound
        np.testing.assert_array_equal(image, expected)
    with pytest.raises(BadFrameError) as caught:
        list(ReadableFrames(load(name, root), checksums="auto"))
    message = str(caught.value)
    assert f"{path} is not the file of {folder / SUMS_FILE}, line " in message
    assert "on_bad_frame=skip" in message and "sha256sum" in message
    if name == "images":  # a picture like any other
        after = images_of(ReadableFrames(load(name, root), checksums="off"))
        assert sum(not np.array_equal(one, other) for one, other in zip(before, after, strict=True)) == 1
        skipping = ReadableFrames(load(name, root), "skip", "auto")
        assert len(skipping) == len(before) - 1 and CHANGED[name] in next(iter(skipping.skipped.values()))


def test_a_list_above_the_images_or_given_by_name_is_taken_and_others_are_not(images_root):
    root, sub = images_root, images_root / "a" / "b"
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
    with pytest.raises(ValueError, match=r"checksums=.*gone cannot be read: give the file, auto or off"):
        ReadableFrames(load("images", sub), checksums=str(root / "gone"))
    assert len(ReadableFrames(Synthetic(size=(8, 6), num_frames=40, stop=2), checksums="auto")) == 2  # has no files


def test_only_images_must_be_listed_and_a_missing_file_is_called_missing(replica_root):
    root, path = replica_root, replica_root / "office9" / SUMS_FILE
    write_list(root / "office9")
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for line in lines if "depth" not in line and "traj" not in line))
    assert list(ReadableFrames(load("replica", root), checksums="auto"))
    path.write_text("".join(lines))
    frames = ReadableFrames(load("replica", root), checksums="auto")
    (root / "office9" / "results" / "depth000001.png").unlink()
    with pytest.raises(BadFrameError, match=r"depth000001\.png is missing"):
        list(frames)


@pytest.mark.parametrize("name", ["plain.jpg", "two  spaces.jpg", "new\nline.jpg", "back\\slash.jpg", "ä.jpg", " x"])
def test_names_are_read_as_sha256sum_writes_them(name, tmp_path):
    digest = hashlib.sha256(b"1").hexdigest()
    for option in ("--text", "--binary"):
        (tmp_path / name).write_bytes(b"1")
        written = subprocess.run(["sha256sum", option, name], cwd=tmp_path, capture_output=True, check=True).stdout
        for text in (written, written.replace(b"\n", b"\r\n"), b"\xef\xbb\xbf" + written + b"\n"):
            (tmp_path / SUMS_FILE).write_bytes(text)
            assert read_sums(tmp_path / SUMS_FILE) == {tmp_path / name: (1, digest)}
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

"""Projects of COLMAP and folders of nerfstudio; oracles: pycolmap, poses that are known, the lens of dataset=images."""

import json

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image
from written_scene import color_image, scene_pose

from emgs_jax.data.base import BadFrameError
from emgs_jax.data.images import Images
from emgs_jax.data.posed_images import Colmap, Nerfstudio
from emgs_jax.data.readable import ReadableFrames
from tests.data.written_benchmarks import CAMERAS, NAMES, write_colmap, write_nerfstudio
from tests.data.written_benchmarks import EUROC_SIZE as SIZE


def turned_by_exif(path, orientation: int) -> None:
    """A picture of another program's, with the same pixels and an EXIF orientation."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    with Image.open(path) as image:
        image.save(path, exif=exif)


@pytest.mark.parametrize("has_size", [False, True])
def test_an_angle_of_view_is_a_camera_as_in_blenders_files(has_size, tmp_path):
    """Its names have no ending, and its size is that of the images."""
    write_nerfstudio(tmp_path)
    values = json.loads((tmp_path / "transforms.json").read_text())
    frames = [frame | {"file_path": f"./{frame['file_path'][:-4]}"} for frame in values["frames"]]
    values = {"camera_angle_x": 2 * np.arctan(0.5), "frames": frames} | ({"w": 160, "h": 120} if has_size else {})
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    dataset = Nerfstudio(str(tmp_path), size=SIZE)
    np.testing.assert_allclose(dataset.intrinsics, (160, 160, 79.5, 59.5))
    np.testing.assert_array_equal(dataset[0].image[..., ::-1], color_image(1, SIZE))
    (tmp_path / "transforms.json").write_text(json.dumps(values | {"camera_angle_y": 2 * np.arctan(0.4)}))
    np.testing.assert_allclose(
        Nerfstudio(str(tmp_path), size=SIZE).intrinsics, (160, 150, 79.5, 59.5)
    )  # as instant-ngp


def test_clips_in_folders_follow_each_other(tmp_path):
    """Images of one name in several folders; COLMAP sorts by the name with its folder."""
    model = write_colmap(tmp_path)
    names = [f"clip{clip}/{i:04d}.png" for clip in (2, 10) for i in range(3)]
    for i, name in enumerate(names):
        (tmp_path / "images" / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "images" / name), color_image(i, SIZE))
    lines = [f"{i + 1} 1 0 0 0 {-0.1 * i} 0 0 7 {name}\n\n" for i, name in enumerate(names)]
    (model / "images.txt").write_text("".join(reversed(lines)))
    frames = [*Colmap(str(tmp_path), size=SIZE)]
    assert [frame.name.split("images/")[1] for frame in frames] == names
    np.testing.assert_allclose([frame.T_world_camera[0, 3] for frame in frames], np.arange(6) / 10)
    assert [frame.timestamp for frame in frames] == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    "change",
    [lambda name: f"images\\{name}", lambda name: f"./images/{name[:-4]}", lambda name: f"images\\{name[:-4]}"],
)
@pytest.mark.parametrize("has_ending_in_capitals", [False, True])
def test_names_with_backslashes_and_without_ending_are_found(change, has_ending_in_capitals, tmp_path):
    write_nerfstudio(tmp_path)
    values = json.loads((tmp_path / "transforms.json").read_text())
    for frame, name in zip(values["frames"], NAMES, strict=True):
        frame["file_path"] = change(name)
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    for path in [*(tmp_path / "images").iterdir()] if has_ending_in_capitals and "." not in change("a.png")[2:] else []:
        path.rename(path.with_suffix(".PNG"))
    dataset = Nerfstudio(str(tmp_path), size=SIZE)
    for i, row in enumerate((1, 0, 2)):
        np.testing.assert_array_equal(dataset[i].image[..., ::-1], color_image(row, SIZE))


@pytest.mark.parametrize("above", [(), ("w", "h"), ("fl_x", "fl_y", "cx", "cy", "w", "h")])
def test_equal_cameras_in_the_frames_are_one(above, tmp_path):
    write_nerfstudio(tmp_path)
    values = json.loads((tmp_path / "transforms.json").read_text())
    camera = {key: values.pop(key) for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    values |= {key: camera[key] for key in above}
    values["frames"] = [frame | camera | {"k1": 0.02} for frame in values["frames"]]
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    dataset = Nerfstudio(str(tmp_path), size=SIZE)
    assert dataset.calibration["intrinsics"] == [130, 128, 80.5, 59] and dataset.calibration["distortion"][0] == 0.02


@pytest.mark.parametrize(("build", "write"), [(Colmap, write_colmap), (Nerfstudio, write_nerfstudio)])
def test_images_come_in_the_order_of_their_numbers_with_their_poses(build, write, tmp_path):
    write(tmp_path)
    dataset = build(str(tmp_path), size=SIZE)
    frames = [dataset[index] for index in range(len(dataset))]
    assert [frame.timestamp for frame in frames] == [2, 10, 33]
    for frame, i in zip(frames, (1, 0, 2), strict=True):
        np.testing.assert_allclose(frame.T_world_camera, scene_pose(i), atol=1e-12)
        np.testing.assert_array_equal(frame.image[..., ::-1], color_image(i, SIZE))
        assert frame.depth is None
    np.testing.assert_allclose(dataset.intrinsics, (130, 128, 80.5, 59))
    assert not dataset.has_ground_truth and len(ReadableFrames(dataset, "skip")) == 3
    # A stretch and a size are chosen as everywhere.
    part = build(str(tmp_path), start=1, stride=1, stop=2, size=(80, 60))
    assert [frame.timestamp for frame in (part[i] for i in range(len(part)))] == [10]
    np.testing.assert_allclose(part.intrinsics, (65, 64, 40, 29.25))
    np.testing.assert_allclose(part[0].T_world_camera, scene_pose(0), atol=1e-12)
    assert part.fingerprint() == build(str(tmp_path), start=1, stop=2, size=(80, 60)).fingerprint()
    assert part.fingerprint() != build(str(tmp_path), size=(80, 60)).fingerprint()
    (tmp_path / "images" / "img2.png").unlink()  # one image that is missing is a bad frame
    dataset = build(str(tmp_path), size=SIZE)
    with pytest.raises(BadFrameError, match="img2.png is missing"):
        dataset[0]
    assert ReadableFrames(dataset, "skip").kept == [1, 2]


@pytest.mark.parametrize("model", CAMERAS)
def test_a_lens_of_colmap_is_the_lens_of_the_same_numbers(model, tmp_path):
    write_colmap(tmp_path, model)
    dataset = Colmap(str(tmp_path), size=SIZE)
    same = Images(str(tmp_path / "images"), size=SIZE, intrinsics=CAMERAS[model][1])
    np.testing.assert_allclose(dataset.intrinsics, same.intrinsics)
    for index in range(3):
        np.testing.assert_array_equal(dataset[index].image, same[index].image)


@pytest.mark.parametrize("second", ["", "10.5 20.25 -1 30 40 1"])
def test_binary_and_text_of_pycolmap_are_read_alike(second, tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="no wheel for Linux on ARM")
    model = write_colmap(tmp_path, "OPENCV", second)
    text = Colmap(str(tmp_path), size=SIZE)
    if second:
        (model / "points3D.txt").write_text("1 0 0 1 255 0 0 -1 3 1 4 1 5 1\n")
    found = pycolmap.Reconstruction(str(model))
    for name, write in (("binary", found.write_binary), ("text", found.write_text)):
        (tmp_path / name).mkdir()
        write(str(tmp_path / name))
        dataset = Colmap(str(tmp_path), model=name, size=SIZE)
        np.testing.assert_allclose(dataset.intrinsics, text.intrinsics)
        for index in range(3):
            np.testing.assert_allclose(dataset.pose(index), text.pose(index), atol=1e-12)
            assert dataset[index].name == text[index].name
    (tmp_path / "binary" / "images.txt").write_text("# what an earlier solution has left")
    (tmp_path / "binary" / "cameras.txt").write_text("")
    assert len(Colmap(str(tmp_path), model="binary", size=SIZE)) == 3, "the binary files count, as in COLMAP"
    for image in found.images.values():
        row = sorted(NAMES, key=lambda name: int(name[3:-4])).index(image.name)
        np.testing.assert_allclose(text.pose(row)[:3, 3], image.projection_center(), atol=1e-9)


def test_a_pose_that_is_not_finite_is_none(tmp_path):
    write_nerfstudio(tmp_path)
    path = tmp_path / "transforms.json"
    values = json.loads(path.read_text())
    values["frames"][1]["transform_matrix"][0][3] = float("nan")
    path.write_text(json.dumps(values))
    dataset = Nerfstudio(str(path.parent), size=SIZE)
    assert dataset.pose(0) is None and dataset.pose(1) is not None


@pytest.mark.parametrize("orientation", [3, 6])
def test_images_are_those_that_are_stored_whatever_their_exif_orientation(orientation, tmp_path):
    """3 is upside down, which came silently with the poses of the pixels in the file; 6 was refused for its size."""
    write_colmap(tmp_path)
    plain = Colmap(str(tmp_path), size=SIZE)[0].image
    for name in NAMES:
        turned_by_exif(tmp_path / "images" / name, orientation)
    assert cv2.imread(str(tmp_path / "images" / NAMES[1])).shape == (
        (120, 160, 3) if orientation == 3 else (160, 120, 3)
    )
    np.testing.assert_array_equal(Colmap(str(tmp_path), size=SIZE)[0].image, plain)


def test_of_several_models_the_largest_is_taken_and_what_has_no_pose_is_said(tmp_path):
    """COLMAP splits what it cannot join: 2 of 10 images were mapped, those of sparse/0, and nothing said so."""
    first = write_colmap(tmp_path)
    second = first.with_name("1")
    second.mkdir()
    lines = (first / "images.txt").read_text().splitlines()
    (second / "images.txt").write_text("\n".join(lines[:5]) + "\n")
    (second / "cameras.txt").write_text((first / "cameras.txt").read_text())
    (first / "images.txt").write_text("\n".join(lines[5:]) + "\n")
    dataset = Colmap(str(tmp_path))
    assert len(dataset) == 2
    assert "1/images.txt has 2 of the 3 images in" in dataset.calibration["note"]
    assert len(Colmap(str(tmp_path), model="sparse/0")) == 1

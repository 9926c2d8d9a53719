"""Runs in other programs' formats; oracles: pycolmap, trimesh, nerfstudio's definition of axes, our own readers."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from hand_run import random_poses
from omegaconf import OmegaConf
from tiny_run import dataset
from written_run import INTRINSICS, SIZE, written_run

from emgs_jax.config import configure
from emgs_jax.data.calibration_files import read_calibration
from emgs_jax.io.cameras import save_frustums
from emgs_jax.io.ply import save_points_ply
from emgs_jax.io.ply_reader import read_vertices
from emgs_jax.ops.camera import Camera
from emgs_jax.runs.export import ExportConfig, export
from emgs_jax.runs.finished_run import read_run
from experiments.export import export_run

ALL = ExportConfig(("colmap", "nerfstudio", "frustums"), 40, None, None)
LOST = 3  # row of the lost frame of a written run


OWN = np.indices((SIZE[1], SIZE[0]))[1] < 4  # what a mask of the user's leaves out of frame 1


class Shown:
    """Images that name their frame."""

    def __getitem__(self, row: int):
        image = np.full((SIZE[1], SIZE[0], 3), 40 * row, np.uint8)
        image[:, :, 0] = 255  # red, so that channels cannot be swapped
        return type("Frame", (), {"image": image, "mask": OWN if row == 1 else None})()


def a_run(folder):
    """With points, and poses in all directions."""
    points = np.random.default_rng(0).normal(size=(100, 3))
    save_points_ply(written_run(folder) / "points.ply", points, points, np.clip(np.abs(points), 0, 1))
    run = read_run(folder)
    return replace(run, poses=random_poses(np.random.default_rng(1), len(run.poses)))


@pytest.fixture
def run(tmp_path):
    return a_run(tmp_path / "run")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A run beside all that can be exported of it."""
    run = a_run(tmp_path_factory.mktemp("run"))
    export(run, run.folder, ALL, Shown())
    return run


def tracked(run):
    return np.delete(run.poses, LOST, axis=0)


def test_pycolmap_reads_the_cameras_where_they_are(written):
    pycolmap = pytest.importorskip("pycolmap", reason="no wheel for Linux on ARM")
    model = pycolmap.Reconstruction(str(written.folder / "colmap" / "sparse" / "0"))
    assert (model.num_images(), model.num_cameras(), model.num_points3D()) == (5, 1, 40)
    for image, pose in zip((model.images[key] for key in sorted(model.images)), tracked(written), strict=True):
        np.testing.assert_allclose(image.projection_center(), pose[:3, 3], atol=1e-9)
        np.testing.assert_allclose(image.cam_from_world().rotation.matrix(), pose[:3, :3].T, atol=1e-9)
        assert (written.folder / "colmap" / "images" / image.name).is_file() and image.name.count(".") == 1
    camera = next(iter(model.cameras.values()))
    assert (camera.width, camera.height) == SIZE, "that of the frames: images on disk may be larger, and bent by a lens"
    # The ray through our principal point, which COLMAP counts from the corner.
    np.testing.assert_allclose(camera.cam_from_img(np.array(INTRINSICS[2:]) + 0.5), 0, atol=1e-6)
    np.testing.assert_allclose(camera.cam_from_img([0.5, 0.5])[0], -INTRINSICS[2] / INTRINSICS[0], rtol=1e-6)


def test_masks_of_what_moves_and_of_the_user_have_the_names_that_other_programs_look_for(tmp_path):
    run = a_run(tmp_path)
    half = {"size": [SIZE[1], SIZE[0]], "counts": [0, SIZE[0] * SIZE[1] // 2, SIZE[0] * SIZE[1] // 2]}
    run.frames[1]["moving_pixels"] = half
    export(run, run.folder, replace(ALL, formats=("colmap", "nerfstudio"), moving="masked"), Shown())
    frames = json.loads((tmp_path / "nerfstudio" / "transforms.json").read_text())["frames"]
    for number, frame in enumerate(frames):
        name = frame["file_path"].rpartition("/")[2]
        ours = tmp_path / "nerfstudio" / frame["mask_path"], tmp_path / "colmap" / "masks" / f"{name}.png"
        for mask in (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in ours):
            expected = np.full(SIZE[::-1], 255)
            expected[: SIZE[1] // 2] *= number != 1
            expected[OWN & (number == 1)] = 0
            np.testing.assert_array_equal(mask, expected)


def test_points_keep_place_and_colour(written):
    cloud = read_vertices(written.folder / "points.ply")
    known = {round(float(x), 5): row for row, x in enumerate(cloud["x"])}
    lines = (written.folder / "colmap" / "sparse" / "0" / "points3D.txt").read_text().splitlines()[1:]
    assert len(lines) == 40
    for line in lines:
        _, x, y, z, *color, _error = line.split()
        row = known[round(float(x), 5)]
        np.testing.assert_allclose([float(y), float(z)], [cloud["y"][row], cloud["z"][row]], rtol=1e-6)
        assert [int(value) for value in color] == [cloud[name][row] for name in ("red", "green", "blue")]
    thinned = read_vertices(written.folder / "nerfstudio" / "points.ply")
    np.testing.assert_allclose(thinned["x"], [float(line.split()[1]) for line in lines], rtol=1e-6)


@pytest.mark.parametrize("name", ["colmap", "nerfstudio"])
def test_images_are_those_of_the_tracked_frames(written, name):
    images = sorted((written.folder / name / "images").iterdir())
    assert [path.name for path in images] == [f"{row:06d}.png" for row in (0, 1, 2, 4, 5)]
    for path in images:
        image = cv2.imread(str(path))
        assert image.shape == (SIZE[1], SIZE[0], 3) and image[0, 0, 2] == 255
        assert image[0, 0, 0] == 40 * int(path.stem)


def test_transforms_look_along_minus_z_with_y_up_and_keep_the_unit(written):
    """nerfstudio's docs/quickstart/data_conventions: +X right, +Y up, +Z back."""
    folder = written.folder / "nerfstudio"
    written_down = json.loads((folder / "transforms.json").read_text())
    for frame, pose in zip(written_down["frames"], tracked(written), strict=True):
        matrix = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(matrix[:3, 0], pose[:3, 0])
        np.testing.assert_allclose(-matrix[:3, 1], pose[:3, 1])
        np.testing.assert_allclose(-matrix[:3, 2], pose[:3, 2])
        np.testing.assert_allclose(matrix[:3, 3], pose[:3, 3])
        assert (folder / frame["file_path"]).is_file()
    assert (folder / written_down["ply_file_path"]).is_file()
    found = read_calibration(folder / "transforms.json")  # our reader of other programs' files
    np.testing.assert_allclose(found.intrinsics, INTRINSICS, rtol=1e-6)
    assert found.size == SIZE and found.distortion == ()


def test_frustums_are_coloured_by_status_and_the_path_is_cut_where_the_camera_was_lost(written):
    mesh = trimesh.load(written.folder / "cameras.ply")
    colors = np.asarray(mesh.visual.vertex_colors)[:, :3]
    counts = {tuple(color): int((colors == color).all(1).sum()) for color in np.unique(colors, axis=0)}
    bar = 6
    expected = {(0x4C, 0x7D, 0xE0): 8, (0x2F, 0x9E, 0x6E): 24, (0xE6, 0x9F, 0x2E): 8, (0xD9, 0x41, 0x3F): 8}
    assert counts == {**{key: bar * value for key, value in expected.items()}, (0xE4, 0x57, 0x2E): bar * 3}
    assert len(mesh.faces) == 6 * (6 * 8 + 3)
    # Each apex is where the camera is: three bars of eight begin in it, round it.
    apex = mesh.vertices[: bar * 8].reshape(8, 2, 3, 3)[:4, 0].mean((0, 1))
    np.testing.assert_allclose(apex, written.poses[0][:3, 3], atol=1e-6)
    ends = mesh.vertices[: bar * 8].reshape(8, 2, 3, 3)[:4, 1].mean((0, 1)) - apex
    assert ends @ written.poses[0][:3, 2] > 0.04, "it opens in the direction of view"


def test_a_camera_that_stands_still_is_written_too(tmp_path):
    camera, poses = Camera((9.0, 9.0), (4.0, 4.0), 9, 9), np.tile(np.eye(4), (2, 1, 1))
    count = save_frustums(tmp_path / "c.ply", camera, poses, np.ones((2, 3)), np.array([True]), np.ones(3))
    mesh = trimesh.load(tmp_path / "c.ply", process=False)
    assert count == len(mesh.faces) and np.isfinite(mesh.vertices).all()


def test_nothing_is_written_over_and_a_failed_export_leaves_nothing(run):
    (run.folder / "colmap").mkdir()
    with pytest.raises(ValueError, match=r"colmap is there already: .* out=FOLDER"):
        export(run, run.folder, ALL, Shown())
    assert not (run.folder / "nerfstudio").exists() and not any((run.folder / "colmap").iterdir())
    (run.folder / "colmap").rmdir()

    class Ends(Shown):
        def __getitem__(self, row: int):
            if row == 4:
                raise OSError(28, "No space left on device")
            return super().__getitem__(row)

    with pytest.raises(OSError, match="No space left"):
        export(run, run.folder, ALL, Ends())
    assert not [path for path in run.folder.iterdir() if "colmap" in path.name]


def test_values_out_of_their_range_and_images_that_are_not_those_that_were_mapped_are_refused(tmp_path):
    """Symptom: a folder with one image more and one less was as good, and every pose had its neighbour's image."""
    folder = written_run(tmp_path / "run")
    config = configure.compose(f"folder='{folder}'", "formats=[colmap]", name="export")
    for value in (0, 1.5, float("nan")):
        with pytest.raises(ValueError, match="max_points"):
            export_run(OmegaConf.merge(config, {"max_points": value}))
    path = folder / "metrics.json"
    metrics = json.loads(path.read_text())
    metrics["provenance"]["data"]["fingerprint"] = "of other images"
    path.write_text(json.dumps(metrics))
    with pytest.raises(ValueError, match="they are not those that were mapped. formats=.frustums. needs no images"):
        export_run(config)


def test_the_command_writes_the_images_that_the_run_was_made_of(tmp_path):
    """The built-in room makes them again; the frame's picture is that of the data set."""
    folder = written_run(tmp_path / "run")
    save_points_ply(folder / "points.ply", np.ones((3, 3)), np.ones((3, 3)), np.ones((3, 3)))
    words = f"folder='{folder}'", "formats=[colmap]", f"out='{tmp_path / 'there'}'"
    found = export_run(configure.compose(*words, name="export"))
    assert found == [tmp_path / "there" / "colmap"]
    image = cv2.cvtColor(cv2.imread(str(found[0] / "images" / "000004.png")), cv2.COLOR_BGR2RGB)
    np.testing.assert_array_equal(image, dataset()[4].image)


def test_a_format_that_is_named_twice_is_written_once(tmp_path):
    """The second one found the first one there."""
    words = f"folder={written_run(tmp_path / 'run')}", f"out={tmp_path / 'there'}"
    twice = export_run(configure.compose(*words, "formats=[frustums,frustums]", name="export"))
    assert twice == [tmp_path / "there" / "cameras.ply"]


def test_images_in_their_own_size_come_with_the_intrinsics_of_that_size(tmp_path):
    """Twice as large as in the run: the same rays, and blocks of four pixels average to the image in use."""
    folder, used = written_run(tmp_path / "run"), dataset()
    save_points_ply(folder / "points.ply", np.ones((3, 3)), np.ones((3, 3)), np.ones((3, 3)))
    path, size = folder / "metrics.json", [2 * side for side in used.size]
    metrics = json.loads(path.read_text())
    metrics["provenance"]["data"]["camera"] = {"size": size}
    path.write_text(json.dumps(metrics))
    words = f"folder='{folder}'", "formats=[colmap]", "images=original", f"out='{tmp_path / 'there'}'"
    found = export_run(configure.compose(*words, name="export"))
    image = cv2.cvtColor(cv2.imread(str(found[0] / "images" / "000004.png")), cv2.COLOR_BGR2RGB)
    assert image.shape == (size[1], size[0], 3)
    blocks = image.reshape(size[1] // 2, 2, size[0] // 2, 2, 3).mean((1, 3))
    assert np.abs(blocks - used[4].image).mean() < 6
    line = (found[0] / "sparse" / "0" / "cameras.txt").read_text().splitlines()[-1].split()
    assert line[1:4] == ["PINHOLE", *map(str, size)]
    fx, fy, cx, cy = used.intrinsics
    np.testing.assert_allclose([float(v) for v in line[4:]], [2 * fx, 2 * fy, 2 * cx + 1, 2 * cy + 1], rtol=1e-6)

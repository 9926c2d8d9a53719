"""7-Scenes: registration, poses of the colour camera, layout."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from written_scene import color_image, moved, plane_depth, scene_pose

from emgs_jax.data.readable import ReadableFrames
from emgs_jax.data.seven_scenes import SevenScenes, register
from emgs_jax.prior.simulated.prior import Simulated

REAL = "redkitchen/seq-01"
T_COLOR_DEPTH = np.array(  # as published with kapture's 7-Scenes; the code's own constant would agree with itself
    [
        [0.99996518, 0.0026765127, -0.0079041012, -0.025558943],
        [-0.0027409311, 0.99996303, -0.0081504521, 0.00010109636],
        [0.0078819942, 0.0081718329, 0.99993555, 0.0020318322],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def load(root, **options):
    return SevenScenes(str(root), "kitchen/seq-01", **{"stride": 1, **options})


@pytest.mark.parametrize("size", [(320, 240), (640, 480), (800, 600), (256, 144)])
def test_registered_depth_is_what_the_colour_camera_would_have_measured(size, seven_scenes_root):
    frame = load(seven_scenes_root, size=size)[2]
    T_world_color = scene_pose(2) @ np.linalg.inv(T_COLOR_DEPTH)
    sx, sy = size[0] / 640, size[1] / 480
    intrinsics = (525 * sx, 525 * sy, 320.5 * sx - 0.5, 240.5 * sy - 0.5)
    truth = plane_depth(T_world_color, intrinsics, size)
    seen = frame.depth > 0
    rows, columns = np.nonzero(seen)
    inner = seen[rows.min() + 6 : rows.max() - 5, columns.min() + 6 : columns.max() - 5]  # within a ragged rim
    assert inner.all(), "holes"
    assert 0.75 < seen.mean() < 0.85  # (525 / 585)^2 = .805 of the image
    # A source pixel is 1/585 wide and the plane's depth changes by 1.6 m a unit at most: 1.4 mm, and .5 mm of rounding.
    assert np.abs(frame.depth - truth)[seen].max() < 0.003
    assert abs((frame.depth - truth)[seen].mean()) < 1e-4, "the nearest square of all was .5 mm before the plane"
    np.testing.assert_allclose(frame.T_world_camera, T_world_color, atol=1e-6)


def test_a_nearer_surface_hides_a_farther_one():
    depth = np.full((480, 640), 2.0, np.float32)
    depth[:, :300] = 1.0
    registered = register(depth, (262.5, 262.5, 159.75, 119.75), (320, 240))
    # Both surfaces shift by t_x f / z, -13.4 and -6.7 pixels of 525: a gap opens, and nothing of 2 m shows left of it.
    row = registered[120]
    assert set(np.round(row[row > 0]).astype(int)) == {1, 2}
    assert np.nonzero(np.round(row) == 2)[0].min() > np.nonzero(np.round(row) == 1)[0].max()


def test_unregistered_depth_keeps_the_files_pose_and_585_and_given_intrinsics_are_of_the_colour_images(
    seven_scenes_root,
):
    dataset = load(seven_scenes_root, register_depth=False)
    np.testing.assert_allclose(dataset.intrinsics, (292.5, 292.5, 159.75, 119.75))
    np.testing.assert_allclose(dataset[1].T_world_camera, scene_pose(1), atol=1e-9)
    truth = plane_depth(scene_pose(1), dataset.intrinsics, (320, 240))
    assert np.abs(dataset[1].depth - truth).max() < 0.003
    dataset = load(seven_scenes_root, intrinsics=[500, 510, 300, 200])
    np.testing.assert_allclose(dataset.intrinsics, (250, 255, 149.75, 99.75))
    frame = dataset[0]
    truth = plane_depth(np.linalg.inv(T_COLOR_DEPTH), dataset.intrinsics, (320, 240))
    assert np.abs(frame.depth - truth)[frame.depth > 0].max() < 0.003


def test_png_and_jpg_are_read_and_the_png_wins(seven_scenes_root):
    folder = seven_scenes_root / "kitchen" / "seq-01"
    for name in ("frame-000000.color.jpg", "frame-0000000.color.jpg"):  # before and after the png by name
        cv2.imwrite(str(folder / name), color_image(5, (640, 480)))
    dataset = load(seven_scenes_root)
    assert [frame.name[-3:] for frame in dataset] == ["png", "jpg", "jpg"]
    assert [frame.timestamp for frame in dataset] == [0, 1, 2]
    np.testing.assert_allclose([f.image[..., 0].mean() for f in dataset], [20, 60, 100], atol=1)  # red names the frame


@pytest.mark.parametrize("text", ["inf " * 16, None])
def test_a_frame_whose_tracking_was_lost_or_whose_pose_is_not_there_has_no_truth(seven_scenes_root, text):
    folder = seven_scenes_root / "kitchen" / "seq-01"
    path = folder / "frame-000001.pose.txt"
    whole = path.read_text()
    for damaged in (whole[:30], "7 " + whole[2:], whole.replace(whole.split()[3], "2e5")):
        path.write_text(damaged)
        with pytest.raises(ValueError, match="frame-000001.pose.txt"):  # before the first frame
            ReadableFrames(load(seven_scenes_root))
    path.unlink() if text is None else path.write_text(text)
    frames = ReadableFrames(load(seven_scenes_root))
    assert [frames.pose(i) is None for i in range(3)] == [False, True, False]
    assert frames[1].T_world_camera is None and frames[1].depth.any()
    with pytest.raises(ValueError, match="needs the true pose of every frame, and 1 of 3 .* is frame 1: choose"):
        Simulated().check(frames, 3)
    for path in folder.glob("*.pose.txt"):
        path.unlink()
    with pytest.raises(ValueError, match="0 of 3 images have a true pose"):
        ReadableFrames(load(seven_scenes_root))


def write_poses(path, poses, sequence="seq-01"):
    """A list of pseudo ground truth of poses by frame number, among lines of another sequence."""
    lines = ["# file qw qx qy qz tx ty tz focal", "seq-02/frame-000000.color.png 1 0 0 0 9 9 9 525", ""]
    for number, T_world_camera in poses.items():
        T = np.linalg.inv(T_world_camera)
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        numbers = " ".join(map(str, [w, x, y, z, *T[:3, 3], 525.5]))
        lines.append(f"{sequence}/frame-{number:06d}.color.png {numbers}")
    path.write_text("\n".join(lines))
    return str(path)


def test_given_poses_are_the_truth_in_place_of_the_files_and_part_of_the_fingerprint(seven_scenes_root, tmp_path):
    poses = {0: scene_pose(2), 2: scene_pose(1)}
    path = write_poses(tmp_path / "sfm.txt", poses)
    with open(path, "a") as file:
        file.write("\nseq-01/frame-000001.color.png nan nan nan nan nan nan nan 525")  # the camera was lost there
    for registered, T in ((True, np.eye(4)), (False, T_COLOR_DEPTH)):
        plain, given = (load(seven_scenes_root, register_depth=registered, poses=p) for p in (None, path))
        for index, pose in poses.items():
            np.testing.assert_allclose(given[index].T_world_camera, pose @ T, atol=1e-7)
            np.testing.assert_array_equal(given[index].depth, plain[index].depth)
        assert given.pose(1) is None and given[1].T_world_camera is None
        before = given.fingerprint()
        assert before != plain.fingerprint()
    write_poses(tmp_path / "sfm.txt", poses | {0: scene_pose(1)})
    assert load(seven_scenes_root, register_depth=False, poses=path).fingerprint() != before


def test_registration_brings_real_points_and_colours_together(shared_data, depth_gaps):
    """The README's check of the calibration: .98 with registration, .94 with 585 for the colour camera."""
    scores = {}
    for registered in (True, False):
        dataset = SevenScenes(shared_data("7scenes"), REAL, stride=10, register_depth=registered)
        scores[registered] = np.median([photometric_correlation(dataset, i, i + 1) for i in (0, 5, 10, 15)])
        if registered:
            gaps = np.concatenate([depth_gaps(dataset, i, i + 1) for i in (0, 10)])
            assert np.median(np.abs(gaps)) < 0.015, "points of one frame lie on the surfaces of the next"
    assert scores[True] > 0.96
    assert scores[True] > scores[False] + 0.02


def photometric_correlation(dataset, i: int, j: int) -> float:
    a, b = dataset[i], dataset[j]
    pixels, (x, y, z) = moved(dataset, i, j)
    depth = map_coordinates(b.depth, [y, x], order=0)
    visible = (z > 0.1) & (np.abs(depth - z) < 0.1)
    there = map_coordinates(b.image.mean(-1), [y[visible], x[visible]], order=1)
    return float(np.corrcoef(a.image.mean(-1)[tuple(pixels[:, visible])], there)[0, 1])

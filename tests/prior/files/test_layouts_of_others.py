"""Folders as other programs write them, by their own code's names and conventions: what is read is the truth."""

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_run
from scipy.spatial.transform import Rotation
from written_predictions import Named, asked, truth, write_npz

from emgs_jax.data.backprojection import backproject
from emgs_jax.prior.base import relative_poses
from emgs_jax.prior.files.layouts import dust3r_crop, mapanything_crop, read_export, vggt_place
from emgs_jax.prior.files.prior import image_intrinsics
from emgs_jax.prior.files.view import Camera, View, at_frame

NUMBERS = Named(names=[str(index) for index in range(tiny_run.NUM_FRAMES)])
fx, fy, cx, cy = tiny_run.dataset().intrinsics
K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32)


def stacked(**more):
    """All frames as one array each."""
    frames = truth()
    arrays = {
        "depth": np.stack([frame.depth for frame in frames]),
        "T": np.stack([frame.T_world_camera for frame in frames]),
    }
    arrays["confidence"] = 1 + arrays["depth"]
    return arrays["depth"], arrays["confidence"], arrays["T"], np.tile(K, (len(frames), 1, 1))


def write_mapanything(folder: Path) -> None:
    """scripts/gradio_app.py: camera -> world (n, 4, 4), depth (n, h, w, 1), final_mask."""
    depth, confidence, T, K = stacked()
    mask = np.ones(depth.shape, bool)
    arrays = {"extrinsic": T, "intrinsic": K, "conf": confidence, "depth": depth[..., None], "final_mask": mask}
    np.savez(folder / "predictions.npz", world_points=np.zeros((*depth.shape, 3)), **arrays)


def write_depth_anything_3(folder: Path) -> None:
    """utils/export/npz.py: exports/npz/results.npz, compressed, world -> camera (n, 3, 4)."""
    depth, confidence, T, K = stacked()
    path = folder / "exports" / "npz" / "results.npz"
    path.parent.mkdir(parents=True)
    extrinsics = np.linalg.inv(T)[:, :3].astype(np.float32)
    image = np.zeros((*depth.shape, 3), np.uint8)
    np.savez_compressed(path, image=image, depth=depth, conf=confidence, extrinsics=extrinsics, intrinsics=K)


def write_cut3r(folder: Path) -> None:
    """demo.py: depth/ and conf/ as .npy, camera/ with pose (camera -> world) and intrinsics."""
    for name in ("depth", "conf", "camera"):
        (folder / name).mkdir()
    for row, (depth, confidence, T, K) in enumerate(zip(*stacked(), strict=True)):
        np.save(folder / "depth" / f"{row:06d}.npy", depth)
        np.save(folder / "conf" / f"{row:06d}.npy", confidence)
        np.savez(folder / "camera" / f"{row:06d}.npz", pose=T.astype(np.float32), intrinsics=K)


def write_da3_streaming(folder: Path) -> None:
    """da3_streaming.py: results_output/frame_N.npz, whose confidence counts from 0, and camera_poses.txt."""
    (folder / "results_output").mkdir()
    depths, confidence, T, K = stacked()
    for row, (depth, sure, camera) in enumerate(zip(depths, confidence, K, strict=True)):
        path = folder / "results_output" / f"frame_{row}.npz"
        np.savez_compressed(
            path, image=np.zeros((*depth.shape, 3), np.uint8), depth=depth, conf=sure - 1, intrinsics=camera
        )
    (folder / "camera_poses.txt").write_text("\n".join(" ".join(map(repr, pose.ravel().tolist())) for pose in T))


def write_colmap(folder: Path) -> None:
    """`colmap image_undistorter` and `patch_match_stereo`; of the last image no depth was found."""
    (folder / "sparse").mkdir()
    (folder / "stereo" / "depth_maps").mkdir(parents=True)
    camera = f"1 PINHOLE 64 48 {fx} {fy} {cx + 0.5} {cy + 0.5}\n"  # COLMAP counts from the corner
    (folder / "sparse" / "cameras.txt").write_text(camera)
    lines = []
    for row, frame in enumerate(truth()[:-1]):
        T = np.linalg.inv(frame.T_world_camera)
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        lines += [f"{row + 1} {w} {x} {y} {z} {T[0, 3]} {T[1, 3]} {T[2, 3]} 1 {row}.jpg", ""]
        content = b"64&48&1&" + struct.pack("<3072f", *frame.depth.ravel())
        (folder / "stereo" / "depth_maps" / f"{row}.jpg.geometric.bin").write_bytes(content)
    (folder / "sparse" / "images.txt").write_text("\n".join(lines) + "\n")


def write_scannet(folder: Path) -> None:
    """SensReader: depth/N.png in mm, pose/N.txt, intrinsic/intrinsic_depth.txt; tracking was lost at the end."""
    for name in ("depth", "pose", "intrinsic"):
        (folder / name).mkdir()
    camera = np.eye(4)
    camera[:3, :3] = K
    np.savetxt(folder / "intrinsic" / "intrinsic_depth.txt", camera)
    for row, frame in enumerate(truth()):
        cv2.imwrite(str(folder / "depth" / f"{row}.png"), np.rint(frame.depth * 1000).astype(np.uint16))
        pose = np.full((4, 4), -np.inf) if row == len(truth()) - 1 else frame.T_world_camera
        np.savetxt(folder / "pose" / f"{row}.txt", pose)


def write_record3d(folder: Path) -> None:
    """EXR + JPG: metadata.json with K by columns, of images twice as large, and poses of ARKit's axes, qx … tz."""
    openexr = pytest.importorskip("OpenEXR")
    (folder / "depth").mkdir()
    poses = []
    for row, frame in enumerate(truth()):
        T = frame.T_world_camera * [1, -1, -1, 1]
        poses.append([*Rotation.from_matrix(T[:3, :3]).as_quat(), *T[:3, 3]])
        header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
        with openexr.File(header, {"R": frame.depth}) as file:
            file.write(str(folder / "depth" / f"{row}.exr"))
    big = np.array([[2 * fx, 0, 2 * cx + 0.5], [0, 2 * fy, 2 * cy + 0.5], [0, 0, 1]])
    about = {"w": 128, "h": 96, "K": big.T.ravel().tolist(), "poses": poses}
    (folder / "metadata.json").write_text(json.dumps(about))


LAYOUTS = {
    "MapAnything": (write_mapanything, True, 1e-5, None),
    "Depth Anything 3": (write_depth_anything_3, False, 1e-5, None),
    "DA3-Streaming": (write_da3_streaming, False, 1e-5, None),
    "CUT3R": (write_cut3r, False, 1e-5, None),
    "COLMAP": (write_colmap, False, 1e-5, -1),
    "ScanNet": (write_scannet, True, 0.9e-3, -1),  # half a millimetre along the ray
    "Record3D": (write_record3d, True, 1e-5, None),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_what_a_program_writes_is_read_as_the_truth_that_it_holds(layout, tmp_path, capsys):
    """The last frame may be one that the program could not solve."""
    write, is_metric, tolerance, lost = LAYOUTS[layout]
    write(tmp_path)
    prior, predictions = asked(tmp_path, NUMBERS)
    assert prior.provenance.settings["scale"] == ("metric" if is_metric else "arbitrary")
    if not is_metric:
        assert np.median(predictions[0].points[0, ..., 2]) == pytest.approx(2.0, rel=1e-5)
        _, predictions = asked(tmp_path, NUMBERS, scale="metric")
    assert f"layout {layout}, metres" in capsys.readouterr().out
    poses = np.stack([frame.T_world_camera for frame in truth()])
    if lost is not None:
        poses[lost] = np.nan
    for prediction in predictions:
        expected = relative_poses(poses[list(prediction.window.views)])
        np.testing.assert_allclose(prediction.T_anchor_view, expected, atol=1e-5)  # float32
        for row, index in enumerate(prediction.window.dense):
            is_known = np.isfinite(poses[index]).all()
            assert prediction.mask[row].all() == is_known and prediction.mask[row].any() == is_known
            points = backproject(truth()[index].depth * is_known, (fx, fy, cx, cy))
            np.testing.assert_allclose(prediction.points[row], points, atol=tolerance)


def write_vggt(folder: Path, camera: Camera, poses: np.ndarray, height: int) -> None:
    """demo_gradio.py: images of width 518, world -> camera (n, 3, 4), depth (n, h, w, 1), depth_conf; of a plane."""
    depth, intrinsics = seen(camera, (518, round(518 / camera.aspect / 14) * 14), (518, height))
    count = len(poses)
    np.savez(
        folder / "predictions.npz",
        pose_enc=np.zeros((count, 9)),
        depth=np.tile(depth[None, ..., None], (count, 1, 1, 1)),
        depth_conf=np.full((count, *depth.shape), 3.0),
        extrinsic=np.linalg.inv(poses)[:, :3],
        intrinsic=np.tile(intrinsics, (count, 1, 1)),
    )


def seen(camera: Camera, scaled: tuple[int, int], grid: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the plane z + .2 x = 2 and the camera matrix, of the middle of an image that was resized."""
    (x, y), (fx, fy, cx, cy) = (s / size for s, size in zip(scaled, camera.size, strict=True)), camera.intrinsics
    left, top = ((whole - part) // 2 for whole, part in zip(scaled, grid, strict=True))
    values = fx * x, fy * y, (cx + 0.5) * x - 0.5 - left, (cy + 0.5) * y - 0.5 - top
    rays = backproject(np.ones(grid[::-1]), values)
    matrix = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1]])
    return 2 / (rays @ [0.2, 0, 1]), matrix


CROPS = [  # the camera of the frames, the whole image as the network resizes it, what it keeps, and the rule
    (Camera((64, 48), (60, 60, 31.5, 23.5)), (518, 392), (518, 392), vggt_place),
    (Camera((48, 64), (60, 60, 23.5, 31.5)), (518, 686), (518, 518), vggt_place),
    (Camera((64, 48), (60, 60, 31.5, 23.5)), (518, 392), (518, 518), vggt_place),  # mode pad
    (Camera((48, 64), (60, 60, 23.5, 31.5)), (392, 518), (518, 518), vggt_place),  # likewise, and as large as cropped
    (Camera((48, 48), (60, 60, 23.5, 23.5)), (512, 512), (512, 384), dust3r_crop),
    (Camera((48, 64), (60, 60, 23.5, 31.5)), (384, 512), (384, 512), dust3r_crop),
    (Camera((60, 48), (60, 60, 29.5, 23.5)), (518, 414), (518, 392), mapanything_crop),
    (Camera((64, 64), (45, 60, 31.5, 31.5)), (518, 392), (518, 392), vggt_place),  # frames that are squeezed
]


@pytest.mark.parametrize(("camera", "scaled", "grid", "crop"), CROPS)
def test_what_a_network_sees_of_an_image_is_found_by_its_own_rule(camera, scaled, grid, crop):
    """A point lies on the ray of the frame's pixel and on the plane; beyond what is kept there is none."""
    depth, matrix = seen(camera, scaled, grid)
    view = View("file", depth, None, tuple(matrix[[0, 1, 0, 1], [0, 1, 2, 2]]))
    points, _, mask = at_frame(view, camera, crop, 0.1)
    rays = backproject(np.ones(mask.shape), camera.intrinsics)
    np.testing.assert_allclose(points[mask] / points[mask][:, 2:], rays[mask], atol=2e-4)  # sides are whole pixels
    np.testing.assert_allclose(points[mask] @ [0.2, 0, 1], 2, atol=1e-4)
    share = min(grid[0] * grid[1] / (scaled[0] * scaled[1]), 1.0)
    assert mask.mean() == pytest.approx(share, abs=2 / min(camera.size))


@pytest.mark.parametrize(("camera", "scaled", "grid"), [row[:3] for row in CROPS if row[3] is vggt_place][:4])
def test_the_camera_of_images_is_that_which_their_predictions_hold(camera, scaled, grid, tmp_path):
    depth, matrix = seen(camera, scaled, grid)
    arrays = {"pose_enc": np.zeros((3, 9)), "depth": np.tile(depth, (3, 1, 1)), "intrinsic": np.tile(matrix, (3, 1, 1))}
    np.savez(tmp_path / "predictions.npz", extrinsic=np.tile(np.eye(4)[:3], (3, 1, 1)), **arrays)
    assert image_intrinsics(tmp_path, camera.size) == pytest.approx(camera.intrinsics, abs=0.3)


def test_vggts_file_is_read_with_its_own_crop(tmp_path):
    room = tiny_run.dataset()
    camera = Camera(room.size, room.intrinsics)
    poses = np.tile(np.eye(4), (tiny_run.NUM_FRAMES, 1, 1))
    poses[:, 1, 3] = np.linspace(0, 0.3, len(poses))  # along the plane, which looks the same
    write_vggt(tmp_path, camera, poses, round(518 / camera.aspect / 14) * 14)
    prior, predictions = asked(tmp_path, NUMBERS, median_depth=1.0)
    assert prior.provenance.settings["layout"] == "VGGT"
    for prediction in predictions:
        assert np.median(prediction.points[0, ..., 2]) == pytest.approx(1, rel=1e-3)
        assert np.all(prediction.confidence == 3) and prediction.mask.all()
        steps = prediction.T_anchor_view[:, 1, 3] / prediction.T_anchor_view[1, 1, 3]
        expected = poses[list(prediction.window.views), 1, 3]
        np.testing.assert_allclose(steps, expected / expected[1], atol=1e-6)


def test_a_scene_as_a_network_returns_it_has_a_dimension_more_and_two_scenes_are_refused(tmp_path):
    """Who followed "must be 4 by 4, camera -> world" wrote wrong poses."""
    poses = np.tile(np.eye(4), (tiny_run.NUM_FRAMES, 1, 1))
    write_vggt(tmp_path, Camera(tiny_run.dataset().size, tiny_run.dataset().intrinsics), poses, 392)
    path = tmp_path / "predictions.npz"
    arrays = dict(np.load(path))
    expected = read_export(path)
    for count in (1, 2):
        np.savez(path, **{name: np.stack([array] * count) for name, array in arrays.items()})
        if count == 2:
            with pytest.raises(ValueError, match=r"got \(2, \d+, 3, 4\): more than one scene"):
                read_export(path)
        else:
            np.testing.assert_array_equal(read_export(path).poses, expected.poses)
            np.testing.assert_array_equal(read_export(path).read(3).geometry, arrays["depth"][3, ..., 0])


def edit(folder, name, change):
    path = folder / name
    path.write_bytes(change(path.read_bytes()))


DAMAGED = [
    (write_mapanything, ("predictions.npz", lambda content: b"no"), "has no arrays, and known are MapAnything"),
    (
        write_colmap,
        ("stereo/depth_maps/0.jpg.geometric.bin", lambda c: c[:-4]),
        "0.jpg.geometric.bin is no depth map of",
    ),
    # Its distortion was ignored: the dense maps of COLMAP are of undistorted images.
    (
        write_colmap,
        ("sparse/cameras.txt", lambda content: content.replace(b"PINHOLE", b"OPENCV").strip() + b" .1 0 0 0\n"),
        "cameras.txt: depth maps are of undistorted images",
    ),
]


@pytest.mark.parametrize(("write", "damage", "message"), DAMAGED)
def test_a_file_that_is_of_no_known_program_or_ends_early_is_named(write, damage, message, tmp_path):
    write(tmp_path)
    edit(tmp_path, *damage)
    with pytest.raises(ValueError, match=message):
        asked(tmp_path, NUMBERS)


def test_a_grid_that_cannot_be_of_the_images_is_refused_with_what_may_have_turned_them():
    view = View("row 0", np.ones((392, 518)), None, (400.0, 400.0, 258.5, 195.5))
    with pytest.raises(ValueError, match=r"is 518x392, .* 0\.750 times as wide as high VGGT has 518x518: .*EXIF"):
        vggt_place(Camera((48, 64), (60, 60, 23.5, 31.5)), view)


def test_one_file_may_be_given_in_place_of_its_folder(tmp_path):
    write_mapanything(tmp_path)
    path = (tmp_path / "predictions.npz").rename(tmp_path / "mine.npz")
    assert asked(path, NUMBERS)[0].provenance.settings["layout"] == "MapAnything"
    assert asked(write_npz(tmp_path / "own", NUMBERS.names), NUMBERS)[0].provenance.settings["layout"] == "npz"

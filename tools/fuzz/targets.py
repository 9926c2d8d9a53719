"""Inputs from outside: how a sound one is written, how it is read, and what must be true of the result."""

import hashlib
import json
import struct
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from omegaconf import OmegaConf
from scipy.spatial.transform import Rotation

from emgs_jax import load_config
from emgs_jax.back_end.factors import FrameData
from emgs_jax.back_end.saved_map import load_places, save_places
from emgs_jax.back_end.state import BackEnd, Refusal, add_node
from emgs_jax.config.configure import compose, keys_of
from emgs_jax.config.values import check_values
from emgs_jax.data.base import Dataset, Frame
from emgs_jax.data.bonn import Bonn
from emgs_jax.data.checksums import SUMS_FILE
from emgs_jax.data.class_file import read_classes
from emgs_jax.data.euroc import Euroc
from emgs_jax.data.images import Images
from emgs_jax.data.kitti import Kitti
from emgs_jax.data.posed_images import Colmap, Nerfstudio
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.data.reading import is_rigid
from emgs_jax.data.replica import Replica
from emgs_jax.data.rosbag import RosBag
from emgs_jax.data.seven_scenes import SevenScenes
from emgs_jax.data.synthetic import Synthetic
from emgs_jax.data.tum import Tum
from emgs_jax.evaluation.clouds import read_cloud
from emgs_jax.evaluation.segmentation import read_labelled_mesh
from emgs_jax.features.text import TextEmbeddings, load_text, save_text
from emgs_jax.gaussian_map import empty_map
from emgs_jax.io.cameras import save_colmap, save_transforms
from emgs_jax.io.map_file import load_map, save_map
from emgs_jax.io.ply import save_points_ply
from emgs_jax.io.trajectory import load_trajectory_tum, save_trajectory_tum
from emgs_jax.loop_closure.place_recognition import Keyframe, add_keyframe
from emgs_jax.mapping.atlas import Atlas
from emgs_jax.mapping.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from emgs_jax.mapping.records import FrameRecord
from emgs_jax.ops.camera import Camera
from emgs_jax.prior.base import windows
from emgs_jax.prior.files.prior import Files
from emgs_jax.prior.recorded import Recorded, record
from emgs_jax.prior.simulated.prior import Simulated
from emgs_jax.report.finished_run import read_run
from emgs_jax.report.page import write_report
from tests.data.written_benchmarks import write_euroc, write_kitti
from tests.data.written_scene import color_image, plane_depth, scene_pose, write_depth

from .damage import BYTES, TEXT, WORDS, Damage

NUM_FRAMES = 3
SIZE = (48, 36)
KITCHEN = (640, 480)
TESTS = Path(__file__).resolve().parents[2] / "tests"  # where pytest looks for what tests share


class Target(NamedTuple):
    """One kind of input.

    Args:
        name: of it.
        write: a sound one into a folder.
        read: it; raises AssertionError where what comes back breaks a promise.
        damages: of a file, by the end of its name; a file with no such end stays sound.
    """

    name: str
    write: Callable[[Path], None]
    read: Callable[[Path], None]
    damages: dict[str, tuple[Damage, ...]]


def _image(path: Path, index: int, size: tuple[int, int]) -> None:
    cv2.imwrite(str(path), color_image(index, size))


def _depth(path: Path, size: tuple[int, int], scale: float) -> None:
    center = (size[0] - 1) / 2, (size[1] - 1) / 2
    write_depth(path, plane_depth(scene_pose(0), (size[0], size[0], *center), size), scale)


def check_frames(dataset: Dataset) -> None:
    """Every frame is of the promised shape and range."""
    frames = ReadableFrames(dataset)
    assert np.isfinite(frames.intrinsics).all() and min(frames.intrinsics[:2]) > 0
    for row in range(min(len(frames), NUM_FRAMES)):
        frame, (width, height) = frames[row], frames.size
        assert frame.image.dtype == np.uint8 and frame.image.shape == (height, width, 3)
        if frame.depth is not None:
            assert frame.depth.shape == (height, width) and np.isfinite(frame.depth).all() and frame.depth.min() >= 0
        if frame.T_world_camera is not None:
            pose = np.asarray(frame.T_world_camera, np.float64)
            assert is_rigid(pose) and np.abs(pose[:3, 3]).max() <= 1001
        assert frame.timestamp is None or np.isfinite(frame.timestamp)


def write_seven_scenes(folder: Path) -> None:
    (folder / "seq-01").mkdir(parents=True)
    for i in range(NUM_FRAMES):
        stem = folder / "seq-01" / f"frame-{i:06d}"
        _depth(stem.with_name(stem.name + ".depth.png"), KITCHEN, 1000)
        _image(stem.with_name(stem.name + ".color.jpg"), i, KITCHEN)
        np.savetxt(stem.with_name(stem.name + ".pose.txt"), scene_pose(i))


def write_tum(folder: Path) -> None:
    sequence = folder / "rgbd_dataset_freiburg3_plane"
    for name in ("rgb", "depth"):
        (sequence / name).mkdir(parents=True)
    lists = {"rgb": "# color\n", "depth": "# depth\n", "groundtruth": "# t tx ty tz qx qy qz qw\n"}
    for i in range(NUM_FRAMES):
        _image(sequence / "rgb" / f"{100 + i}.png", i, SIZE)
        _depth(sequence / "depth" / f"{100 + i}.png", SIZE, 5000)
        lists["rgb"] += f"{100 + i}.0 rgb/{100 + i}.png\n"
        lists["depth"] += f"{100 + i}.01 depth/{100 + i}.png\n"
        lists["groundtruth"] += f"{100 + i}.0 {0.04 * i} 0 0 0 {np.sin(0.025 * i)} 0 {np.cos(0.025 * i)}\n"
    for name, text in lists.items():
        (sequence / f"{name}.txt").write_text(text)


def write_replica(folder: Path) -> None:
    (folder / "office9" / "results").mkdir(parents=True)
    camera = {"w": SIZE[0], "h": SIZE[1], "fx": 60.0, "fy": 60.0, "cx": 23.5, "cy": 17.5, "scale": 6553.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}, indent=1))
    for i in range(NUM_FRAMES):
        _image(folder / "office9" / "results" / f"frame{i:06d}.jpg", i, SIZE)
        _depth(folder / "office9" / "results" / f"depth{i:06d}.png", SIZE, 6553.5)
    rows = [" ".join(f"{v:.9e}" for v in scene_pose(i).ravel()) for i in range(NUM_FRAMES)]
    (folder / "office9" / "traj.txt").write_text("\n".join(rows))


def write_listed_images(folder: Path) -> None:
    write_images(folder)
    write_sums(folder)


def write_sums(folder: Path) -> None:
    sums = [(hashlib.sha256(path.read_bytes()).hexdigest(), path.name) for path in sorted(folder.iterdir())]
    (folder / SUMS_FILE).write_text("".join(f"{digest}  {name}\n" for digest, name in sums))


def read_listed_images(folder: Path) -> None:
    """Whatever was damaged, what is read is what was written."""
    dataset = Images(folder, size=SIZE, intrinsics=(60, 60, 23.5, 17.5))
    frames = ReadableFrames(dataset, checksums=str(folder / SUMS_FILE))
    sound = {number: color_image(row, SIZE) for row, number in enumerate((2.0, 10.0, 33.0))}
    for frame in frames:  # a picture of a JPEG is a little different
        assert np.abs(frame.image.astype(int) - sound[frame.timestamp][..., ::-1]).mean() < 3


def write_images(folder: Path) -> None:
    for i, name in enumerate(("img2.png", "img10.jpg", "img33.bmp")):
        _image(folder / name, i, SIZE)


POSED = ("img2.png", "img10.jpg", "img33.bmp")  # as write_images names them
PINHOLE = Camera((60.0, 60.0), (23.5, 17.5), *SIZE)


def write_colmap(folder: Path) -> None:
    (folder / "images").mkdir()
    write_images(folder / "images")
    (folder / "sparse").mkdir()
    poses = np.stack([scene_pose(i) for i in range(NUM_FRAMES)])
    save_colmap(folder / "sparse", PINHOLE, POSED, poses, np.zeros((0, 3)), np.zeros((0, 3)))


def write_binary_colmap(folder: Path) -> None:
    """cameras.bin and images.bin of one PINHOLE camera, each image with two points."""
    write_colmap(folder)
    for path in (folder / "sparse").iterdir():
        path.unlink()
    camera = struct.pack("<QIiQQ4d", 1, 1, 1, *SIZE, 60.0, 60.0, 24.0, 18.0)
    (folder / "sparse" / "cameras.bin").write_bytes(camera)
    images = struct.pack("<Q", len(POSED))
    for number, name in enumerate(POSED, start=1):
        inverse = np.linalg.inv(scene_pose(number - 1))
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        images += struct.pack("<I7dI", number, w, x, y, z, *inverse[:3, 3], 1) + name.encode() + b"\0"
        images += struct.pack("<Q2dQ2dQ", 2, 3.0, 4.0, 7, 5.0, 6.0, 2**64 - 1)
    (folder / "sparse" / "images.bin").write_bytes(images)


def write_video(folder: Path) -> None:
    writer = cv2.VideoWriter(str(folder / "a.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10, SIZE)
    for index in range(2 * NUM_FRAMES):
        writer.write(color_image(index, SIZE))
    writer.release()


def write_rosbag(folder: Path, version: int) -> None:
    from tests.data.written_bag import write_bag

    write_bag(folder, version, "CompressedImage" if version == 1 else "Image")


def write_nerfstudio(folder: Path) -> None:
    write_images(folder)
    poses = np.stack([scene_pose(i) for i in range(NUM_FRAMES)])
    save_transforms(folder / "transforms.json", PINHOLE, POSED, poses, "points.ply")


CALIBRATIONS = {
    "cameras.txt": "# Camera list\n1 OPENCV 48 36 50.5 50.25 24 18 .1 -.2 .001 -.002\n",
    "transforms.json": json.dumps({"fl_x": 50.5, "fl_y": 50.2, "cx": 24, "cy": 18, "w": 48, "h": 36, "k1": 0.1}),
    "orb.yaml": "%YAML:1.0\nCamera.type: PinHole\nCamera.fx: 50.5\nCamera.fy: 50.2\nCamera.cx: 23.5\nCamera.cy: 17.5\n"
    "Camera.width: 48\nCamera.height: 36\nCamera.k1: 0.1\nCamera.k2: 0\nCamera.p1: 0\nCamera.p2: 0\n",
    "camchain.yaml": "cam0:\n  camera_model: pinhole\n  distortion_coeffs: [.02, -.01, .003, .001]\n"
    "  distortion_model: equidistant\n  intrinsics: [50.5, 50.2, 23.5, 17.5]\n  resolution: [48, 36]\n",
    "intrinsics.yaml": "width: 48\nheight: 36\ncalibration: [50.5, 50.2, 23.5, 17.5]\n",
    "plain.json": json.dumps({"fx": 50.5, "fy": 50.2, "cx": 23.5, "cy": 17.5, "width": 48, "height": 36}),
}


def write_calibrations(folder: Path) -> None:
    (folder / "images").mkdir()
    _image(folder / "images" / "1.png", 1, SIZE)
    for name, text in CALIBRATIONS.items():
        (folder / name).write_text(text)


def read_calibrations(folder: Path) -> None:
    """Those that are sound as well: a folder has one that is damaged."""
    for name in CALIBRATIONS:
        check_frames(Images(folder / "images", size=SIZE, intrinsics=str(folder / name)))


def write_trajectory(folder: Path) -> None:
    save_trajectory_tum(
        folder / "trajectory.txt", np.arange(NUM_FRAMES), np.stack([scene_pose(i) for i in range(NUM_FRAMES)])
    )


def read_trajectory(folder: Path) -> None:
    times, poses = load_trajectory_tum(folder / "trajectory.txt")
    assert np.isfinite(times).all() and is_rigid(poses) and len(times) == len(poses)


@cache
def _recorded() -> tuple[Dataset, Simulated]:
    dataset = ReadableFrames(Synthetic(size=SIZE, num_frames=40, stop=NUM_FRAMES))
    return dataset, Simulated(seed=0, feature_size=4, classes=dataset.classes)


def write_recording(folder: Path) -> None:
    record(_recorded()[1], _recorded()[0], 2, folder / "recording")


def read_recording(folder: Path) -> None:
    dataset, prior = _recorded()[0], Recorded(folder / "recording")
    prior.check(dataset, 2)
    for window in windows(len(dataset), 2):
        found = prior.predict(window, [dataset[i] for i in window.views], dataset.intrinsics)
        assert found.points.shape == (len(window.dense), SIZE[1], SIZE[0], 3)
        assert np.isfinite(found.points[found.mask]).all()


def _frames() -> list[Frame]:
    return [_recorded()[0][index] for index in range(NUM_FRAMES)]


def write_predictions(folder: Path) -> None:
    for frame in _frames():
        keys = {"depth": frame.depth, "confidence": 1 + frame.depth, "intrinsics": _recorded()[0].intrinsics}
        np.savez_compressed(folder / f"{frame.index}.npz", T_world_camera=frame.T_world_camera, **keys)


def write_depth_images(folder: Path) -> None:
    for frame in _frames():
        cv2.imwrite(str(folder / f"{frame.index}.png"), np.rint(1000 * frame.depth).astype(np.uint16))
    poses = {str(frame.index): frame.T_world_camera.tolist() for frame in _frames()}
    (folder / "poses.json").write_text(
        json.dumps({"T_world_camera": poses, "intrinsics": [*_recorded()[0].intrinsics]})
    )


def read_predictions(folder: Path) -> None:
    dataset = _recorded()[0]
    given = {"scale": "auto", "median_depth": 2.0, "depth_scale": 1000.0, "max_depth_step": 0.03}
    prior = Files(folder, **given, pose_std=None, max_misfit=0.1)
    prior.check(dataset, 2)
    for window in windows(len(dataset), 2):
        found = prior.predict(window, [dataset[i] for i in window.views], dataset.intrinsics)
        assert np.isfinite(found.points[found.mask]).all() and (found.points[found.mask][:, 2] > 0).all()
        assert np.isfinite(found.confidence).all() and (found.confidence >= 1).all()
        assert is_rigid(found.T_anchor_view[np.isfinite(found.T_anchor_view).all((1, 2))])


def _reseal(folder: Path) -> None:
    """Make the checksums fit, as a forger would: what is behind them is looked at, too."""
    path = folder / "recording" / "manifest.json"
    try:
        manifest = json.loads(path.read_text())
        manifest["files"] = {
            name: hashlib.sha256((path.parent / name).read_bytes()).hexdigest() for name in manifest["files"]
        }
        manifest.pop("sha256", None)
        text = json.dumps(manifest, sort_keys=True, separators=(",", ":")).encode()
        path.write_text(json.dumps(manifest | {"sha256": hashlib.sha256(text).hexdigest()}))
    except Exception:
        return  # no JSON any more, or of another shape


def read_forged_recording(folder: Path) -> None:
    _reseal(folder)
    read_recording(folder)


def write_map(folder: Path) -> None:
    map, rng = empty_map(16, 4), np.random.default_rng(0)
    gaussians = map.gaussians
    new = rng.normal(size=(16, 3)), np.tile(np.eye(3), (16, 1, 1)), np.arange(16) < 9
    gaussians = eqx.tree_at(lambda g: (g.means, g.covs, g.valid), gaussians, tuple(jnp.asarray(x) for x in new))
    cast = jax.tree.map(lambda leaf, like: jnp.asarray(leaf, like.dtype), gaussians, map.gaussians)
    save_map(folder / "map.npz", eqx.tree_at(lambda m: m.gaussians, map, cast))


def read_map(folder: Path) -> None:
    map = load_map(folder / "map.npz")
    assert np.isfinite(np.asarray(map.gaussians.means)[np.asarray(map.gaussians.valid)]).all()


def write_places(folder: Path) -> None:
    end, rng = empty_back_end(), np.random.default_rng(0)
    image, mask = np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), bool)
    for frame in range(3):
        end = add_node(end, FrameData(frame, image, np.zeros((48, 64, 3)), mask, {}), np.eye(4), 1.0, None)
        pixels, descriptors = rng.uniform(0, 40, (9, 2)), rng.integers(0, 99, (9, 128))
        shown = np.float32(pixels), np.uint8(descriptors), np.full((9, 3), np.nan, np.float32)
        one = Keyframe(frame, *shown, end.intrinsics, (64, 48), np.zeros((6, 8), np.float16))
        end = replace(end, database=add_keyframe(end.database, one, end.config.place_recognition))
    save_places(folder / "places.npz", end, 0.01)


@cache
def empty_back_end() -> BackEnd:
    return BackEnd(load_config("graph=default").graph, (50.0, 50.0, 31.5, 23.5), 0.01)


def read_places(folder: Path) -> None:
    end, _ = load_places(folder / "places.npz", empty_back_end())
    assert np.isfinite(end.poses).all() and len(end.nodes) == end.first_node
    assert all(0 <= one.frame < len(end.nodes) for one in end.database.keyframes)


def write_cloud(folder: Path) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3))
    save_points_ply(
        folder / "points.ply", points, points / np.linalg.norm(points, axis=1, keepdims=True), rng.random((50, 3))
    )


def read_points(folder: Path) -> None:
    cloud = read_cloud(folder / "points.ply", 8)
    assert len(cloud) and all(np.isfinite(rows).all() for rows in (cloud.points, cloud.normals, cloud.colors))


def write_embeddings(folder: Path) -> None:
    rng = np.random.default_rng(0)
    save_text(folder / "text.npz", TextEmbeddings(("wall", "chair"), rng.normal(size=(2, 8)), ("a {}",), {"name": "m"}))


def read_embeddings(folder: Path) -> None:
    found = load_text(folder / "text.npz", {"name": "m"}, ("chair",))
    assert found.vectors.shape == (1, 8) and np.isfinite(found.vectors).all()


CLASS_LINES = "93 wall\n20 chair\n"
CLASS_YAML = "class_names_reduced: [wall, chair]\nmap_to_reduced: {93: 0, 20: 1, -1: 2}\nclass_names: [none, lamp]\n"


def write_labelled_mesh(folder: Path) -> None:
    points = np.random.default_rng(0).normal(size=(4, 3))
    save_points_ply(folder / "a_mesh.ply", points, points, np.zeros((4, 3)))
    (folder / "a.txt").write_text("93\n20\n20\n93\n")
    (folder / "classes.txt").write_text(CLASS_LINES)
    (folder / "classes.yaml").write_text(CLASS_YAML)


def read_classes_and_mesh(folder: Path) -> None:
    for name in ("classes.txt", "classes.yaml"):
        found = read_labelled_mesh(folder, "a", read_classes(folder / name))
        assert len(found.points) == len(found.labels) and found.labels.max(initial=-1) < len(found.classes)
        assert all(name.strip() for name in found.classes)


def write_checkpoint(folder: Path) -> None:
    records = [FrameRecord(i, str(i), 0.1 * i, "tracked", pose=scene_pose(i), raw_pose=scene_pose(i)) for i in range(2)]
    atlas = Atlas(None, None, replace(empty_back_end(), refusals=(Refusal(0, 1, "matches", 0.5),)))
    save_checkpoint(folder / "checkpoint.npz", Checkpoint(2, atlas, (8, 8), tuple(records)), {"a": 1})


def read_checkpoint(folder: Path) -> None:
    found = load_checkpoint(folder / "checkpoint.npz", {"a": 1})
    assert isinstance(found, Checkpoint)


def write_finished_run(folder: Path) -> None:
    if str(TESTS) not in sys.path:
        sys.path.append(str(TESTS))
    from tests.report.written_run import written_run

    written_run(folder / "room")


def read_finished_run(folder: Path) -> None:
    """Check that a run that can be read has a page, and poses and frames that belong together."""
    run = read_run(folder / "room")
    assert is_rigid(run.poses) and len(run.poses) == len(run.frames) == len(run.raw) == len(run.truth)
    text = write_report(run, None).read_text(encoding="utf-8")
    assert text.lstrip().lower().startswith("<!doctype html>") and text.rstrip().endswith("</html>")


@cache
def _keys() -> tuple[str, ...]:
    names = ("dataset=synthetic", "graph=default", "baseline=all")
    return tuple(sorted(key for key in keys_of(compose(*names)) if "_target_" not in key))


def write_words(folder: Path) -> None:
    """The words of a command line, one a line."""
    (folder / "words").write_text("slam.em.noise=0.5\nprior.seed=3\nslam.window_size=8\n")


def change_words(data: bytes, rng: np.random.Generator) -> bytes:
    """A key and a value that may not be its own; now and then a key that is none."""
    keys, lines = _keys(), []
    for _ in range(rng.integers(1, 4)):
        key = keys[rng.integers(len(keys))]
        if rng.integers(10) == 0:
            key = key[: rng.integers(1, len(key) + 1)]
        lines.append(f"{key}={WORDS[rng.integers(len(WORDS))]}")
    return "\n".join(lines).encode()


def read_words(folder: Path) -> None:
    words = [line for line in (folder / "words").read_text(encoding="utf-8").split("\n") if line]
    config = load_config("graph=default", "baseline=all", *words)
    for part in config.settings:
        check_values(OmegaConf.create(config.settings), part)
    for leaf in jax.tree.leaves((config.slam, config.densify)):
        assert not np.isnan(np.asarray(leaf, np.float64)).any()


def targets() -> Iterator[Target]:
    """All kinds of inputs."""
    image = {".png": BYTES, ".jpg": BYTES, ".bmp": BYTES}
    yield Target(
        "seven_scenes",
        write_seven_scenes,
        lambda f: check_frames(SevenScenes(f, "seq-01", size=SIZE, stride=1)),
        image | {".txt": TEXT},
    )
    yield Target(
        "tum",
        write_tum,
        lambda f: check_frames(
            Tum(f, "rgbd_dataset_freiburg3_plane", size=SIZE, stride=1, intrinsics=(60, 60, 23.5, 17.5))
        ),
        image | {".txt": TEXT},
    )
    yield Target(
        "bonn",
        write_tum,
        lambda f: check_frames(
            Bonn(f, "rgbd_dataset_freiburg3_plane", size=SIZE, stride=1, intrinsics=(60, 60, 23.5, 17.5))
        ),
        image | {".txt": TEXT},
    )
    yield Target(
        "euroc",
        write_euroc,
        lambda f: check_frames(Euroc(f, "MH_01_easy", size=SIZE)),
        image | {".csv": TEXT, ".yaml": TEXT},
    )
    yield Target("kitti", write_kitti, lambda f: check_frames(Kitti(f, "07", size=SIZE)), image | {".txt": TEXT})
    yield Target(
        "replica",
        write_replica,
        lambda f: check_frames(Replica(f, "office9", size=SIZE, stride=1)),
        image | {".txt": TEXT, ".json": TEXT},
    )
    yield Target(
        "images", write_images, lambda f: check_frames(Images(f, size=SIZE, intrinsics=(60, 60, 23.5, 17.5))), image
    )
    yield Target("colmap", write_colmap, lambda f: check_frames(Colmap(f, size=SIZE)), image | {".txt": TEXT})
    yield Target(
        "nerfstudio", write_nerfstudio, lambda f: check_frames(Nerfstudio(f, size=SIZE)), image | {".json": TEXT}
    )
    yield Target(
        "colmap binary", write_binary_colmap, lambda f: check_frames(Colmap(f, size=SIZE)), image | {".bin": BYTES}
    )
    yield Target(
        "video",
        write_video,
        lambda f: check_frames(Images(f / "a.mp4", size=SIZE, intrinsics=(60, 60, 23.5, 17.5))),
        {".mp4": BYTES},
    )
    if find_spec("rosbags") is not None:
        bag = lambda name: lambda f: check_frames(RosBag(f, name, size=SIZE))  # noqa: E731
        yield Target("bag of ROS 1", lambda f: write_rosbag(f, 1), bag("walk.bag"), {".bag": BYTES})
        yield Target("bag of ROS 2", lambda f: write_rosbag(f, 2), bag("walk"), {".db3": BYTES, ".yaml": TEXT})
    yield Target("checksums", write_listed_images, read_listed_images, image | {SUMS_FILE: TEXT})
    yield Target("calibration", write_calibrations, read_calibrations, {".txt": TEXT, ".json": TEXT, ".yaml": TEXT})
    yield Target("trajectory", write_trajectory, read_trajectory, {".txt": TEXT})
    yield Target("recording", write_recording, read_recording, {".npz": BYTES, ".json": TEXT})
    yield Target("forged recording", write_recording, read_forged_recording, {".npz": BYTES, ".json": TEXT})
    yield Target("predictions", write_predictions, read_predictions, {".npz": BYTES})
    yield Target("depth images", write_depth_images, read_predictions, {".png": BYTES, ".json": TEXT})
    yield Target("map", write_map, read_map, {".npz": BYTES})
    yield Target("places", write_places, read_places, {".npz": BYTES})
    yield Target("points", write_cloud, read_points, {".ply": (*BYTES, *TEXT)})
    yield Target("text embeddings", write_embeddings, read_embeddings, {".npz": BYTES})
    damages = {".txt": TEXT, ".yaml": TEXT, ".ply": BYTES}
    yield Target("labelled mesh", write_labelled_mesh, read_classes_and_mesh, damages)
    yield Target("checkpoint", write_checkpoint, read_checkpoint, {".npz": BYTES})
    damages = {".npz": BYTES, ".json": TEXT, ".jsonl": TEXT, "trajectory.txt": TEXT, "trajectory_online.txt": TEXT}
    yield Target("finished run", write_finished_run, read_finished_run, damages)
    yield Target("command line", write_words, read_words, {"words": (change_words,)})

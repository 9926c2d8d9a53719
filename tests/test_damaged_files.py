"""Files from outside, damaged: each is read, and then what is read keeps its promises, or one error names the file."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from emgs_jax import load_config
from emgs_jax.back_end.factors import FrameData
from emgs_jax.back_end.saved_map import load_places, save_places
from emgs_jax.back_end.state import BackEnd, Refusal, add_node
from emgs_jax.data.base import Dataset, Frame
from emgs_jax.data.bonn import Bonn
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
from emgs_jax.io.map_file import load_map, save_map
from emgs_jax.io.ply import save_points_ply
from emgs_jax.io.trajectory import load_trajectory_tum, save_trajectory_tum
from emgs_jax.loop_closure.place_recognition import Keyframe, add_keyframe
from emgs_jax.mapping.atlas import Atlas
from emgs_jax.mapping.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from emgs_jax.mapping.records import FrameRecord
from emgs_jax.prior.base import windows
from emgs_jax.prior.files.prior import Files
from emgs_jax.prior.recorded import Recorded, record
from emgs_jax.prior.simulated.prior import Simulated
from emgs_jax.report.page import write_report
from emgs_jax.runs.finished_run import read_run
from tests.data.written_benchmarks import write_colmap, write_euroc, write_kitti, write_nerfstudio
from tests.data.written_scene import color_image, scene_pose, write_images, write_replica, write_seven_scenes, write_tum
from tests.written_run import written_run

NUM_FRAMES, SIZE = 3, (48, 36)
PINHOLE = (60.0, 60.0, 23.5, 17.5)
TEXT = {".txt", ".json", ".jsonl", ".yaml", ".csv"}
WORDS = (
    *("nan", "inf", "-inf", "1e400", "-1", "0", "-0", "1e6", "1e30", "1e-30", "2.5", "99999999999999999999", "0x10"),
    *("", "abc", "None", "null", "true", "[]", "{}", "[1,2]", "é", "\x00", "1,5", "1_000", "+-1", '"', "..", "1e", "#"),
)


def check_frames(dataset: Dataset) -> None:
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


def write_binary_colmap(folder: Path) -> None:
    """As COLMAP's own program writes it."""
    pycolmap = pytest.importorskip("pycolmap")
    model = write_colmap(folder)
    reconstruction = pycolmap.Reconstruction(str(model))
    for path in model.iterdir():
        path.unlink()
    reconstruction.write_binary(str(model))


def write_video(folder: Path) -> None:
    writer = cv2.VideoWriter(str(folder / "a.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10, SIZE)
    for index in range(2 * NUM_FRAMES):
        writer.write(color_image(index, SIZE))
    writer.release()


def write_bag(folder: Path, version: int) -> None:
    from tests.data.written_bag import write_bag

    write_bag(folder, version, "CompressedImage" if version == 1 else "Image")


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
    cv2.imwrite(str(folder / "images" / "1.png"), color_image(1, SIZE))
    for name, text in CALIBRATIONS.items():
        (folder / name).write_text(text)


def read_calibrations(folder: Path) -> None:
    for name in CALIBRATIONS:
        check_frames(Images(folder / "images", size=SIZE, intrinsics=str(folder / name)))


def write_trajectory(folder: Path) -> None:
    save_trajectory_tum(folder / "trajectory.txt", np.arange(3), np.stack([scene_pose(i) for i in range(3)]))


def read_trajectory(folder: Path) -> None:
    times, poses = load_trajectory_tum(folder / "trajectory.txt")
    assert np.isfinite(times).all() and is_rigid(poses) and len(times) == len(poses)


@cache
def room() -> tuple[Dataset, list[Frame]]:
    dataset = ReadableFrames(Synthetic(size=SIZE, num_frames=40, stop=NUM_FRAMES))
    return dataset, [dataset[index] for index in range(NUM_FRAMES)]


def read_prior(prior) -> None:
    dataset, frames = room()
    prior.check(dataset, 2)
    for window in windows(range(len(dataset)).__contains__, 2):
        found = prior.predict(window, [frames[i] for i in window.views], dataset.intrinsics)
        assert found.points.shape == (len(window.dense), SIZE[1], SIZE[0], 3)
        assert np.isfinite(found.points[found.mask]).all() and (found.points[found.mask][:, 2] > 0).all()
        assert np.isfinite(found.confidence).all() and (found.confidence >= 1).all()
        assert is_rigid(found.T_anchor_view[np.isfinite(found.T_anchor_view).all((1, 2))])


def write_recording(folder: Path) -> None:
    record(Simulated(seed=0, feature_size=4, classes=room()[0].classes), room()[0], 2, folder / "recording")


def write_predictions(folder: Path) -> None:
    for frame in room()[1]:
        keys = {"depth": frame.depth, "confidence": 1 + frame.depth, "intrinsics": room()[0].intrinsics}
        np.savez_compressed(folder / f"{frame.index}.npz", T_world_camera=frame.T_world_camera, **keys)


def write_depth_images(folder: Path) -> None:
    for frame in room()[1]:
        cv2.imwrite(str(folder / f"{frame.index}.png"), np.rint(1000 * frame.depth).astype(np.uint16))
    poses = {str(frame.index): frame.T_world_camera.tolist() for frame in room()[1]}
    (folder / "poses.json").write_text(json.dumps({"T_world_camera": poses, "intrinsics": [*room()[0].intrinsics]}))


def read_predictions(folder: Path) -> None:
    given = {"scale": "auto", "median_depth": 2.0, "depth_scale": 1000.0, "max_depth_step": 0.03}
    read_prior(Files(folder, **given, pose_std=None, max_misfit=0.1))


def write_map(folder: Path) -> None:
    map, rng = empty_map(16, 4), np.random.default_rng(0)
    new = rng.normal(size=(16, 3)), np.tile(np.eye(3), (16, 1, 1)), np.arange(16) < 9
    gaussians = eqx.tree_at(lambda g: (g.means, g.covs, g.valid), map.gaussians, tuple(jnp.asarray(x) for x in new))
    cast = jax.tree.map(lambda leaf, like: jnp.asarray(leaf, like.dtype), gaussians, map.gaussians)
    save_map(folder / "map.npz", eqx.tree_at(lambda m: m.gaussians, map, cast))


def read_map(folder: Path) -> None:
    map = load_map(folder / "map.npz")
    assert np.isfinite(np.asarray(map.gaussians.means)[np.asarray(map.gaussians.valid)]).all()


@cache
def empty_back_end() -> BackEnd:
    return BackEnd(load_config("graph=default").graph, (50.0, 50.0, 31.5, 23.5), 0.01)


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


def read_places(folder: Path) -> None:
    end, _ = load_places(folder / "places.npz", empty_back_end())
    assert np.isfinite(end.poses).all() and len(end.nodes) == end.first_node
    assert all(0 <= one.frame < len(end.nodes) for one in end.database.keyframes)


def write_cloud(folder: Path) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    save_points_ply(folder / "points.ply", points, normals, np.abs(normals))


def read_points(folder: Path) -> None:
    cloud = read_cloud(folder / "points.ply", 8)
    assert len(cloud) and all(np.isfinite(rows).all() for rows in (cloud.points, cloud.normals, cloud.colors))


def write_embeddings(folder: Path) -> None:
    vectors = np.random.default_rng(0).normal(size=(2, 8))
    save_text(folder / "text.npz", TextEmbeddings(("wall", "chair"), vectors, ("a {}",), {"name": "m"}))


def read_embeddings(folder: Path) -> None:
    found = load_text(folder / "text.npz", {"name": "m"}, ("chair",))
    assert found.vectors.shape == (1, 8) and np.isfinite(found.vectors).all()


def write_labelled_mesh(folder: Path) -> None:
    points = np.random.default_rng(0).normal(size=(4, 3))
    save_points_ply(folder / "a_mesh.ply", points, points, np.zeros((4, 3)))
    (folder / "a.txt").write_text("93\n20\n20\n93\n")
    (folder / "classes.txt").write_text("93 wall\n20 chair\n")
    (folder / "classes.yaml").write_text(
        "class_names_reduced: [wall, chair]\nmap_to_reduced: {93: 0, 20: 1, -1: 2}\nclass_names: [none, lamp]\n"
    )


def read_classes_and_mesh(folder: Path) -> None:
    for name in ("classes.txt", "classes.yaml"):
        found = read_labelled_mesh(folder, "a", read_classes(folder / name))
        assert len(found.points) == len(found.labels) and found.labels.max(initial=-1) < len(found.classes)
        assert all(name.strip() for name in found.classes)


def write_checkpoint(folder: Path) -> None:
    records = [FrameRecord(i, str(i), 0.1 * i, "tracked", pose=scene_pose(i), raw_pose=scene_pose(i)) for i in range(2)]
    atlas = Atlas(None, None, replace(empty_back_end(), refusals=(Refusal(0, 1, "matches", 0.5),)))
    save_checkpoint(folder / "checkpoint.npz", Checkpoint(2, atlas, (8, 8), tuple(records)), {"a": 1})


def read_finished_run(folder: Path) -> None:
    """A run that can be read has a page, and poses and frames that belong together."""
    run = read_run(folder / "room")
    assert is_rigid(run.poses) and len(run.poses) == len(run.frames) == len(run.raw) == len(run.truth)
    assert write_report(run, None).read_text(encoding="utf-8").rstrip().endswith("</html>")


def frames_of(make: Callable, *names: str, **options) -> Callable[[Path], None]:
    return lambda folder: check_frames(make(folder, *names, size=SIZE, **options))


FREIBURG = "rgbd_dataset_freiburg3_plane"
READERS: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {  # how it is written, and read
    "seven_scenes": (write_seven_scenes, frames_of(SevenScenes, "kitchen/seq-01", stride=1)),
    "tum": (write_tum, frames_of(Tum, FREIBURG, stride=1)),
    "bonn": (write_tum, frames_of(Bonn, FREIBURG, stride=1)),
    "euroc": (write_euroc, frames_of(Euroc, "MH_01_easy")),
    "kitti": (write_kitti, frames_of(Kitti, "07")),
    "replica": (write_replica, frames_of(Replica, "office9", stride=1)),
    "images": (write_images, frames_of(Images, intrinsics=(128, 128, 79.5, 59.5))),
    "colmap": (write_colmap, frames_of(Colmap)),
    "binary colmap": (write_binary_colmap, frames_of(Colmap)),
    "nerfstudio": (write_nerfstudio, frames_of(Nerfstudio)),
    "video": (write_video, lambda f: check_frames(Images(f / "a.mp4", size=SIZE, intrinsics=PINHOLE))),
    "calibration": (write_calibrations, read_calibrations),
    "trajectory": (write_trajectory, read_trajectory),
    "recording": (write_recording, lambda folder: read_prior(Recorded(folder / "recording"))),
    "predictions": (write_predictions, read_predictions),
    "depth images": (write_depth_images, read_predictions),
    "map": (write_map, read_map),
    "places": (write_places, read_places),
    "points": (write_cloud, read_points),
    "text embeddings": (write_embeddings, read_embeddings),
    "labelled mesh": (write_labelled_mesh, read_classes_and_mesh),
    "checkpoint": (write_checkpoint, lambda folder: load_checkpoint(folder / "checkpoint.npz", {"a": 1})),
    "finished run": (lambda folder: written_run(folder / "room"), read_finished_run),
}
if find_spec("rosbags") is not None:
    READERS["bag of ROS 1"] = lambda folder: write_bag(folder, 1), frames_of(RosBag, "walk.bag")
    READERS["bag of ROS 2"] = lambda folder: write_bag(folder, 2), frames_of(RosBag, "walk")


@st.composite
def damaged(draw, whole: bytes, is_text: bool) -> bytes:
    """What disks, transfers and editors do to a file."""
    place = draw(st.integers(0, len(whole)))
    length, noise = draw(st.integers(1, 600)), draw(st.binary(min_size=1, max_size=40))
    kinds = [
        whole[:place],
        whole[:place] + noise + whole[place:],
        whole[:place] + whole[place + length :],
        (whole[:place] + draw(st.sampled_from((bytes(length), b"\xff" * length))) + whole[place + length :])[
            : len(whole)
        ],
        whole + whole,
    ]
    flipped = bytearray(whole)
    for place in draw(st.lists(st.integers(0, len(whole) - 1), min_size=1, max_size=8)):
        flipped[place] ^= 1 << draw(st.integers(0, 7))
    kinds.append(bytes(flipped))
    header = [*re.finditer(rb"\d+", whole[:800])]
    if header:
        digits = draw(st.sampled_from(header))
        kinds.append(whole[: digits.start()] + str(draw(st.integers(0, 10**9))).encode() + whole[digits.end() :])
    if is_text:
        lines = whole.split(b"\n")
        row = draw(st.integers(0, len(lines) - 1))
        word = draw(st.sampled_from([*re.finditer(rb"[^\s,:=\[\]{}]+", whole)]))
        new = draw(st.sampled_from(WORDS)).encode()
        kinds += [b"\n".join([*lines[:row], *lines[row + 1 :]]), b"\n".join([*lines[: row + 1], *lines[row:]])]
        kinds += [whole[: word.start()] + new + whole[word.end() :]] * 4
        kinds += [b"\xef\xbb\xbf" + whole.replace(b"\n", b"\r\n"), whole.decode("latin-1").encode("utf-16")]
    return draw(st.sampled_from(kinds))


def check(name: str, sound: Path, **how) -> None:
    """Damage one file of a copy, and read it."""
    write, read = READERS[name]
    write(sound)
    read(sound)
    files = [path.relative_to(sound) for path in sorted(sound.rglob("*")) if path.is_file()]
    contents = {path: (sound / path).read_bytes() for path in files}

    @settings(deadline=None, database=None, suppress_health_check=list(HealthCheck), **how)
    @given(st.data())
    def one(data) -> None:
        path = data.draw(st.sampled_from([path for path in files if contents[path]]), "file")
        content = data.draw(st.none() | damaged(contents[path], path.suffix in TEXT), "content")
        with TemporaryDirectory() as temporary:
            folder = Path(temporary) / "input"
            shutil.copytree(sound, folder)
            (folder / path).unlink()
            if content is not None:
                (folder / path).write_bytes(content)
            try:
                read(folder)
            except (ValueError, OSError) as error:
                names = [str(folder), path.parent.name, *(other.name for other in files)]  # a list may name another one
                assert any(word in str(error) for word in names if word), f"names no file: {error}"

    one()


@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_is_read_or_named_by_the_error(name, tmp_path):
    check(name, tmp_path, max_examples=3, derandomize=True)


@pytest.mark.weekly
@pytest.mark.parametrize("name", READERS)
def test_no_damage_of_many_is_a_fault(name, tmp_path):
    check(name, tmp_path, max_examples=100, print_blob=True)

"""What readers of data sets and of predictions say, see `messages`."""

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import tiny_run
from hydra.errors import InstantiationException
from PIL import ExifTags, Image

from emgs_jax.config.configure import build, compose, message_of
from emgs_jax.data.apartment import Apartment
from emgs_jax.data.bonn import Bonn
from emgs_jax.data.calibration_files import read_calibration
from emgs_jax.data.class_file import read_classes
from emgs_jax.data.euroc import Euroc
from emgs_jax.data.images import Images
from emgs_jax.data.kitti import Kitti
from emgs_jax.data.masks import Masks
from emgs_jax.data.posed_images import Colmap, Nerfstudio
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.data.replica import Replica
from emgs_jax.data.rosbag import RosBag
from emgs_jax.data.seven_scenes import SevenScenes
from emgs_jax.data.tum import Tum
from emgs_jax.io.trajectory import save_trajectory_tum
from emgs_jax.prior.base import windows
from emgs_jax.prior.files.prior import Files
from emgs_jax.prior.multiview.depth_files import way_of_files
from emgs_jax.prior.network.framework import DINOV2_CLONE, check_checkpoint
from emgs_jax.prior.recorded import Recorded, record
from emgs_jax.prior.simulated.prior import Simulated
from emgs_jax.structure.given import given_models
from emgs_jax.structure.library import member, options_of
from emgs_jax.structure.reconstruct import matcher_of
from emgs_jax.structure.shots import Shots
from tests.data.test_calibration_files import CORNER, KALIBR, MAST3R, ORB, ROS, TRANSFORMS
from tests.data.test_calibration_files import PLAIN as OF_VIPE
from tests.data.written_benchmarks import CAMERAS, EUROC_SIZE, write_colmap, write_euroc, write_kitti, write_nerfstudio
from tests.data.written_scene import color_image, write_replica, write_seven_scenes, write_tum
from tests.messages import Step, check_messages, edit, gone, lines, moved, put, resized
from tests.prior.files.written_predictions import KEYS, NAMES, Named, truth, write_depths, write_npz
from tests.prior.network_double import Double, Sphere, network_of

pytestmark = pytest.mark.slow


def frames(build: Callable, **defaults) -> Callable[..., int]:
    """A reader of all frames of a data set."""

    def read(folder: Path, **options) -> int:
        given = {"root": str(folder), "stride": 1} | defaults | options
        reading = {key: given.pop(key) for key in ("on_bad_frame",) if key in given}
        return len([*ReadableFrames(build(**given), **reading)])

    return read


TUM, FR3 = "rgbd_dataset_freiburg3_plane", [535.4, 539.2, 320.1, 247.6]
COLOR, DEPTH, TRUTH = f"{TUM}/rgb/101.000000.png", f"{TUM}/depth/101.010000.png", f"{TUM}/groundtruth.txt"
IMAGES = [f"{TUM}/{kind}/{100 + i + late:.6f}.png" for i in range(3) for kind, late in (("rgb", 0), ("depth", 0.01))]
LABEL, CLASSES = f"{TUM}/semantic/101.000000.png", f"{TUM}/classes.txt"
WALL = np.full((480, 640), 4, np.uint16)
LABELS = (
    *(put(f"{TUM}/semantic/{100 + i:.6f}.png", WALL) for i in range(3)),
    *(put(CLASSES, "4 wall\n300 cup\n"), {"labels": "semantic"}),
)


def shifted(time: float = 0.0, x: float = 0.0) -> Step:
    """The true path at other times or elsewhere."""
    return lines(TRUTH, lambda words: [f"{float(words[0]) + time:.4f}", str(float(words[1]) + x), *words[2:]])


OF_TUM = [
    ({"root": None}, "give dataset.root=FOLDER"),
    ({"sequence": None}, "give dataset.sequence=NAME"),
    ({"sequence": "fr3"}, r"has: (\w+)$"),
    ({"start": 3}, r"start must be in 0\.\.(\d),"),
    ({"stop": 9}, r"null \(all\) or in 1\.\.(\d),"),
    ({"stop": 0}, r"null \(all\) or in (\d)\.\.3,"),
    ({"stride": 0}, r"must be at least (\d)"),
    ({"start": 0.5}, "must be a whole number of images"),
    ({"size": [320]}, r"must be \[width, height\] in pixels"),
    ({"depth_scale": 0}, "correct it, or leave the key out"),
    ({"intrinsics": [1070.8, 1078.4, 640.7, 495.7]}, "at the size of the images on disk"),
    ({"intrinsics": [500, 0, 320, 240]}, "must be .fx, fy, cx, cy."),
    ({"intrinsics": [*FR3, 0.1]}, r"or \[MODEL, …\]"),
    ({"intrinsics": [*FR3, 0.1, -900, 0, 0]}, "check the order .OPENCV"),
    ((moved(TUM, "desk"), {"sequence": "desk"}), r"\[MODEL,…\]"),
    ({"distortion": [0.1, *[0] * 4]}, "needs the dataset.intrinsics"),
    ({"intrinsics": FR3, "distortion": [0.1]}, r"must be \[k1, k2, p1, p2, k3\]"),
    ({"intrinsics": [*FR3, *[0] * 4], "distortion": [0.1, *[0] * 4]}, r"put it behind them"),
    (gone(COLOR), "is missing: fetch the file again or set on_bad_frame=skip"),
    (put(COLOR, b"\x00\x00\x00\x18ftypheic" + bytes(99)), "or set on_bad_frame=skip"),
    (put(COLOR, b"version https://git-lfs.github.com"), "Git LFS .*git lfs pull fetches it"),
    (put(DEPTH, np.zeros((480, 640), np.uint8)), "must be a 16-bit depth image"),
    (resized(COLOR, (320, 240)), "the file, or .*, or set on_bad_frame=skip"),
    (tuple(resized(image, (320, 240)) for image in IMAGES), "is 320x240,"),
    (edit(TRUTH, ("100.9950 0.04", "100.9950 x")), "line 3: .*: correct the line or take it out"),
    (
        lines(TRUTH, lambda words: [*words[:-1], "9" * (words[0][1] == "0") + words[-1]]),
        "line 3: .*: correct the line or take it out",
    ),
    (edit(TRUTH, ("0.01 0.02 0 0.0", "0.01 0.02 0 9e200 0.0")), "line 3: .* has not length 1: correct"),
    (edit(TRUTH, (" 0 0.99", "")), "groundtruth.txt, line 3: expected a timestamp and 7 more"),
    (edit(f"{TUM}/rgb.txt", ("\n101", "\nx01")), "rgb.txt, line 3: expected a timestamp"),
    (shifted(x=450000.0), "subtract one position from all of its lines"),
    (edit(TRUTH, ("9950 0.04", "9950 9900")), "line 3: has a position of .*, else correct this one"),
    (edit(TRUTH, ("9950 0.04", "9950 400")), "correct the trajectory, or write nan where the pose is not known"),
    (shifted(x=np.nan), "0 of 3 images have a true pose: fetch the trajectory again"),
    (
        (edit(TRUTH, ("99.9950 0.0", "99.9950 nan")), {"stop": 1}),
        r"or choose other images \(dataset.start, stop, stride\)",
    ),
    (shifted(time=0.5), "at 100.000 .*Correct the times, .* raise dataset.max_time_difference, or move the file away"),
    (
        (lines(TRUTH, lambda words: words * (words[0] != "99.9950")), {"stop": 1}),
        r"choose other images \(dataset.start, stop\)",
    ),
    (put(TRUTH, "# nothing\n"), "0 of 3 images have a pose .*lines of this file at no s"),
    (edit(f"{TUM}/depth.txt", *((f"\n10{i}", f"\n50{i}") for i in range(3))), "at 500.010 to 502.010 s"),
    ({"max_time_difference": -1}, "must be seconds, 0 or more"),
    ((LABELS, {"labels": "classes"}), "is no folder: give one with a class image"),
    ((LABELS, put(LABEL, np.zeros((4, 4, 3), np.uint8))), "write the ids, not their colours"),
    ((LABELS, put(LABEL, np.uint8(WALL + 40))), "write it with 16 bits"),
    ((LABELS, put(LABEL, WALL + 3)), r"dataset\.(unknown)="),
    ((LABELS, {"unknown": "7"}), "must be a list of ids, whole numbers from 0"),
    ({"on_bad_frame": "maybe"}, "must be error or skip"),
]


OF_APARTMENT = [
    ({"walk": "round"}, "walk must be one of two_laps, figure_of_eight, out_and_back, twin_rooms, corridor"),
    ({"seed": -1}, "dataset.seed must be 0 or more .* got -1"),
    ({"num_frames": 0}, "dataset.num_frames 1 or more, got 0, 0, 0"),
    ({"movers": -1}, "must be 0 or more .dataset.movers likewise. .* got 0, -1"),
    ({"stride": 0}, "dataset.stride must be at least 1"),
]


OF_BONN = [
    ({"sequence": "rgbd_bonn_balloon"}, r"has: (\w+)$"),
    ({"depth_scale": -1}, "leave the key out for the data set's own"),
    ({"intrinsics": "estimate"}, "build the data set from a config"),
]


SEVEN = "kitchen/seq-01"
POSE = f"{SEVEN}/frame-000001.pose.txt"
PSEUDO = "seq-01/frame-000000.color.png 1 0 0 0 0 0 0 525\n"


def turned(*diagonal: float) -> Step:
    """The first three columns of a pose times numbers."""

    def run(root):
        pose = np.loadtxt(root / POSE)
        np.savetxt(root / POSE, pose * [*diagonal, 1.0])

    return run


OF_SEVEN = [
    (turned(2, 2, 2), "a rotation times (2), .*: divide the first three columns by it"),
    (turned(1, -1, 1), "a mirrored pose, .*: flip two of them, or none"),
    (turned(1, 1, 0.5), "is no rigid motion: fetch the file again or set on_bad_frame=skip"),
    (edit(POSE, (" ", " x ")), "must hold 16 numbers .*: fetch the file again or set"),
    ({"register_depth": False, "intrinsics": [585, 585, 320, 240, 0.1, 0, 0, 0]}, "set dataset.register_depth=true"),
    ((put("p.txt", PSEUDO.replace("01", "09")), {"poses": "{root}/p.txt"}), "has no line of seq-01"),
    (
        (put("p.txt", PSEUDO.replace("1 0", "x 0")), {"poses": "{root}/p.txt"}),
        "line 1 is no pose of the form seq-XX/frame-000000.color.png qw qx qy qz tx ty tz focal",
    ),
]


CAM, TRAJECTORY = "cam_params.json", "office9/traj.txt"


OF_REPLICA = [
    (edit(CAM, ('"w"', '"width"')), 'must hold {"camera": {w, h, fx, fy, cx, cy, scale}}'),
    ((edit(TRAJECTORY, ("\n", "\n\n")), {"stop": 2}), "blank lines among its poses"),
    (put(TRAJECTORY, "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n"), "1 poses, .*: fetch traj.txt again"),
]


TIMES, POSES, CALIB = "sequences/07/times.txt", "poses/07.txt", "sequences/07/calib.txt"


OF_KITTI = [
    (edit(TIMES, ("2.074e-01\n", "")), "2 lines for 3 images: fetch the sequence and this file again"),
    (edit(TIMES, ("0", "x")), "times.txt, line 1: must be 1 finite numbers.*: fetch it again"),
    (edit(POSES, (" ", " x ")), "07.txt, line 1: .* must be 12 numbers.*: fetch the file again"),
    (edit(POSES, ("1.0", "3.0")), "07.txt, line 1: has a pose that is no rigid motion: fetch"),
    (edit(CALIB, ("P2", "P9")), "has no P2: fetch the calibration files"),
    (edit(CALIB, ("P2: 9.2", "P2: -9.2")), "P2 must be that of a rectified camera.*: fetch it again"),
    ({"camera": 0}, r"image_0 is no folder; expected the layout root/\{sequences/00/\{image_(2)"),
    (gone(TIMES), "times.txt is missing"),
    ({"sequence": 9}, "sequences/09 does not exist; expected .*KITTI.* has: (07)"),
]


MAV = "MH_01_easy/mav0"
SENSOR, STATES = f"{MAV}/cam0/sensor.yaml", f"{MAV}/state_groundtruth_estimate0/data.csv"


OF_EUROC = [
    (edit(SENSOR, ("T_BS:", "T_SB:")), "has no T_BS, .*: fetch it again"),
    (edit(SENSOR, ("radial-tangential", "omni")), "omni is not read, only none, .*: undistort .* and give the new"),
    ({"camera": "cam1"}, r"is missing; expected the layout root/SEQUENCE/mav0/\{(cam0)"),
    ({"max_time_difference": 0.0001}, "0 of 3 images have a pose"),
    (edit(SENSOR, ("[160, 120]", "[752, 480]")), "is for images of 752x480, .*: give the calibration"),
    (edit(SENSOR, ("[160, 120]", "752")), r"resolution must have data: \[numbers\]: correct it"),
    (edit(STATES, *[(",0.", ",7.")] * 4), "line 2: .*: correct the line or take it out"),
]


CAMERA, MODEL = "sparse/0/cameras.txt", "sparse/0/images.txt"
FIRST, SECOND = (f"{i} PINHOLE 160 120 {CAMERAS['PINHOLE'][0]}\n".replace("130", f"1{i - 4}0") for i in (7, 8))


OF_COLMAP = [
    (edit(CAMERA, ("160 120", "320 240")), "give the calibration of these images, or these images in that size"),
    (edit(CAMERA, ("160 120", "120 160")), "calibrate the images as they are shown"),
    (edit(CAMERA, ("\n7 ", "\n7 SIMPLE 1\n8 ")), "cameras.txt:2: expected CAMERA_ID MODEL"),
    (edit(CAMERA, ("PINHOLE", "KANNALA")), "KANNALA is not read.*image_undistorter"),
    (edit(MODEL, (" 7 img33", " 8 img33")), "of camera 8, which has no line: export the model again"),
    (edit(MODEL, ("img2.png", "img10.png")), "has img10.png twice: export the model again"),
    (edit(MODEL, ("img2.png\n\n", "img2.png\n")), "image has two lines"),
    (edit(MODEL, ("img10.png\n\n", "IMG 2 (3).png\n")), r"txt:3: expected the points of image IMG 2 \(3\).png"),
    (edit(MODEL, ("\n4 0", "\n4 7")), "images.txt:4: the pose is not finite .*: export the model"),
    (edit(MODEL, ("img10.png", "")), "images.txt:2: expected IMAGE_ID QW.*: export the model again"),
    ((put(CAMERA, FIRST + SECOND), edit(MODEL, (" 7 img33", " 8 img33"))), "2 different cameras"),
    ({"images": "photos"}, "none of them is in .*photos: put the images there"),
    ({"model": "here"}, "no cameras and images .* in .*here"),
    (put(MODEL, "# nothing\n"), "has no images with a pose: register some, or give another model"),
    (gone(MODEL), r"no cameras and images \(.txt or .bin\)"),
    ((moved(CAMERA, f"{CAMERA[:-3]}bin"), moved(MODEL, f"{MODEL[:-3]}bin")), "cameras.bin"),
    (gone("images/img2.png"), "is missing: fetch the file again or set on_bad_frame=skip"),
]


def transforms(**changes) -> Step:
    def run(root):
        values = json.loads((root / "transforms.json").read_text()) | changes
        (root / "transforms.json").write_text(json.dumps({k: v for k, v in values.items() if v is not None}))

    return run


FRAME = {"file_path": "images/img2.png", "transform_matrix": np.eye(4).tolist()}


OF_NERFSTUDIO = [
    (gone("transforms.json"), "transforms.json does not exist; expected the layout"),
    (transforms(frames=[FRAME | {"transform_matrix": [["x"] * 4] * 4}]), "must hold frames with"),
    (transforms(frames=[]), "has no frames: export it again"),
    (transforms(frames=[{"file_path": "images/img2.png"}]), "must hold frames with .*: export it again"),
    (transforms(frames=[FRAME | {"transform_matrix": [[1, 0], [0, 1]]}]), "4 rows of 4: export it again"),
    (transforms(frames=[FRAME | {"transform_matrix": np.ones((4, 4)).tolist()}]), "is no rigid motion"),
    (transforms(frames=[FRAME, FRAME]), "has images/img2.png twice: export it again"),
    (transforms(w=320, h=240), "is for images of 320x240, .*: give the calibration of these images"),
    (transforms(fl_x=None), "has no fl_x: add what is missing, in pixels of the images"),
    (
        transforms(frames=[FRAME, FRAME | {"file_path": "images/img10.png", "fl_x": 99}]),
        "2 different cameras .* map those",
    ),
]


SIZE, SQUARE = EUROC_SIZE, [128, 128, 79.5, 59.5]
FOLDED = (-9, 0, 0, 0), (0, 0, 2, 0), (0, -80, 0, 0)


def write_folder(root: Path) -> None:
    for i in range(3):
        put(f"{i}.png", color_image(i, SIZE))(root)


def photos(*numbers: int, **exif) -> Step:
    """JPEGs, with EXIF tags by name; of what had that name nothing is left."""

    def run(root):
        tags = Image.Exif()
        for name, value in exif.items():
            tags.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base[name]] = value
        for i in numbers or range(3):
            (root / f"{i}.png").unlink(missing_ok=True)
            Image.fromarray(color_image(i, SIZE)).save(root / f"{i}.jpg", exif=tags)

    return run


OF_IMAGES = [
    ({"intrinsics": None}, "fx = fy = .8 times the width and the centre"),
    *(
        (
            (photos(**tags), {"intrinsics": "exif"}),
            "0.jpg has no EXIF FocalLengthIn35mmFilm.*: give dataset.intrinsics=",
        )
        for tags in ({}, {"FocalLength": 4.2}, {"FocalLengthIn35mmFilm": 0})
    ),
    (
        (photos(FocalLengthIn35mmFilm=26), photos(2, FocalLengthIn35mmFilm=50), {"intrinsics": "exif"}),
        "several focal lengths .*: take those of one",
    ),
    (
        (photos(FocalLengthIn35mmFilm=26, ExifImageWidth=4032, ExifImageHeight=2268), {"intrinsics": "exif"}),
        "cut to 160x120, so its EXIF is of another view: give dataset.intrinsics=",
    ),
    ({"intrinsics": [0.8, 1.0667, 0.5, 0.5]}, r"they fit as those normalised by width and height: give \["),
    ({"intrinsics": [128, 79.5, 128, 59.5]}, r"they fit as those in the order fx, cx, fy, cy: give \["),
    ({"intrinsics": [64, 64, 39.5, 29.5]}, r"they fit as those of images of 80x60: give \["),
    ({"intrinsics": [64, 64, 39.5, 29.5]}, "or, where they are right, a calibration file with width and height"),
    ({"intrinsics": [4, 4, 79.5, 59.5]}, "give fx, fy, cx, cy in pixels of the images on disk"),
    ({"intrinsics": "{root}/camera.xml"}, "is none of the calibration files that are known: .* JSON with"),
    ({"intrinsics": "{root}/camera.json"}, "camera.json cannot be read; it may be .* JSON with width"),
    (tuple(put(f"{i}_mask.png", color_image(i, SIZE)) for i in range(3)), "into another folder"),
    (tuple(moved(f"{i}.png", f"rgb/{i}.png") for i in range(3)), r"(\w+): give one of them"),
    (tuple(moved(f"{i}.png", f"{i}.heic") for i in range(3)), "are not read: convert them to jpg or png"),
    (tuple(put(f"{i}.png", b"\x00\x00\x00\x18ftypheic" + bytes(99)) for i in range(3)), "convert it to png or jpg"),
    ({"root": "{root}/0.png"}, "is neither a folder nor a video file"),
    *(({"intrinsics": [*SQUARE, *lens]}, "the distortion .* leaves . % of the 160x120 image") for lens in FOLDED),
    ({"intrinsics": ["OPENCV_FISHEYE", *SQUARE, 0, 9, -60, 0]}, "of the model OPENCV_FISHEYE leaves . % of the"),
    ({"intrinsics": ["OPENCV_FISHEYE", *SQUARE, 0.1]}, "parameters fx, fy, cx, cy, k1, k2, k3, k4, got 5"),
    ({"intrinsics": ["FISHEYE", *SQUARE[:3], "x"]}, "intrinsics: cy must be a finite number, got 'x'"),
    ({"intrinsics": [*SQUARE, np.inf, 0, 0, 0]}, r"dataset.intrinsics must be \[fx, fy, cx, cy\]"),
    ({"intrinsics": 5}, r"dataset.intrinsics must be \[fx, fy, cx, cy\]"),
]


def write_clip(root: Path) -> None:
    writer = cv2.VideoWriter(str(root / "clip.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, SIZE)
    for i in range(6):
        writer.write(color_image(i, SIZE))
    writer.release()


OF_CLIP = [
    ({"intrinsics": "exif"}, "a video has no EXIF: give dataset.intrinsics="),
    ({"intrinsics": [128, 128, 500, 59.5]}, r"principal point outside of the 160x120 images of .*clip\.avi"),
    (put("clip.avi", b""), "clip.avi is empty: copy it again"),
    (put("clip.avi", b"x" * 999), "no video that OpenCV can open: convert it to mp4 .h264. or to images"),
]


def own(suffix: str = ".npz", **changes) -> Step:
    """Predictions of the tiny room in own/, anew; `changes`: see `write_npz`."""

    def run(root):
        shutil.rmtree(root / "own", ignore_errors=True)
        write_npz(root / "own", NAMES, **changes) if suffix == ".npz" else write_depths(root / "own", suffix)

    return run


def listed_poses(count: int = 6) -> Step:
    return lambda root: save_trajectory_tum(
        root / "own" / "poses.txt", range(count), [frame.T_world_camera for frame in truth()[:count]]
    )


def named_poses(count: int = 6) -> Step:
    named = dict(zip(NAMES, (frame.T_world_camera.tolist() for frame in truth()[:count]), strict=False))
    return put("own/poses.json", json.dumps({"T_world_camera": named}))


def pose_of(change: Callable[[np.ndarray], np.ndarray]) -> Step:
    return own(T_world_camera=lambda frame: change(frame.T_world_camera))


def in_unit(lengths: float, poses: float) -> Step:
    moves = np.where(np.arange(4) == 3, [[poses]] * 3 + [[1]], 1)
    return own(depth=lambda frame: lengths * frame.depth, T_world_camera=lambda frame: moves * frame.T_world_camera)


def matrix(frame) -> np.ndarray:
    fx, fy, cx, cy = tiny_run.dataset().intrinsics
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


OF_PREDICTIONS = [
    ({"folder": "{root}"}, r"has no file \*.npz, .* and no known layout \(docs"),
    ({"folder": "{root}/nowhere"}, "does not exist: give the folder of predictions"),
    (own(T_world_camera=None), "npz lacks T_world_camera; it has depth"),
    (own(depth=None), "must have depth or points, one of them"),
    (own(depth=lambda frame: frame.depth.ravel()), r"depth must be depths \(h, w\)"),
    (own(depth=lambda frame: frame.depth[:, :48]), "the whole image with 0 where nothing is known"),
    (in_unit(1000, 1000), "depth in metres: write metres, .* or prior.scale=arbitrary"),
    (
        (own(".png"), listed_poses(), {"depth_scale": 1.0}),
        r"give prior.depth_scale \(units of a metre in .png files; (1000): mm\)",
    ),
    (in_unit(1, 1000), r"the positions by (0\.001)"),
    (pose_of(lambda T: T * [2, 2, 2, 1]), "no rigid motion within 1e\\+06: camera -> world is expected"),
    (pose_of(np.linalg.inv), "taken as world -> camera: expected are poses camera -> world"),
    (pose_of(lambda T: T * [1, -1, -1, 1]), "as camera -> world of OpenGL's axes: expected"),
    (own(depth=lambda frame: 1 / frame.depth), r"/ depth: expected are .* depths along z"),
    (own(depth=lambda frame: frame.depth * (0.5 + frame.index % 2)), r"of their own in each: align them"),
    (own(confidence=lambda frame: np.full(frame.depth.shape, 0.3)), r"such as probabilities, give 1 \+ confidence"),
    (own(confidence=lambda frame: np.full(frame.depth.shape, np.inf)), "and is inf"),
    (own(confidence=lambda frame: np.ones((4, 5))), r"confidence must be numbers \(48, 64\), as what it is of"),
    (own(intrinsics=lambda frame: [999, 999, 320, 240]), r"give those of the file's own size \(64x48\)"),
    (own(intrinsics=lambda frame: matrix(frame).T), "cy, 0 0 1, row by row, .*: transpose it"),
    (own(intrinsics=lambda frame: [1, 2, 3]), r"must be \[fx, fy, cx, cy\] or a camera matrix"),
    (own(depth=lambda frame: frame.depth * np.nan), "none of its 6 files has a depth above 0"),
    (gone("own/IMG_9.npz"), "predict it"),
    ({"names": ["a", "b", "c"]}, "or choose the frames that were predicted"),
    (put("own/IMG_9.npz", b"PK"), "IMG_9.npz: .*; it has nothing"),
    ((own(".npy"), listed_poses(), put("own/IMG_9.npy", b"x")), "no .npy that can be read .*: write it again"),
    (own(".npy"), "of poses.txt, poses.json: poses are needed beside depths"),
    ((own(".npy"), listed_poses(5)), "must have one for each"),
    (
        (own(".npy"), listed_poses(), lines("own/poses.txt", lambda words: [f"{9 - float(words[0])}", *words[1:]])),
        r"not in order of time, .*: write the lines in the order IMG_8, IMG_9, IMG_10, …, or give poses.json",
    ),
    ((own(".npy"), named_poses(1)), "lacks T_world_camera of 5 of 6 files"),
    ((own(".npy"), put("own/poses.json", "[]")), 'must hold {"T_world_camera": {"name of the file'),
    ({"scale": "relative"}, "must be one of auto, (metric), arbitrary"),
    ({"scale": "arbitrary", "median_depth": 0.0}, "must be above 0 m"),
    ({"depth_scale": 0.0}, "must be raw units per metre, above 0"),
]


def read_own(root: Path, names: list[str] = NAMES, folder: str | None = None, **keys) -> int:
    """The answers of `prior=files` to all windows of frames that have these names."""
    found, frames = Named(names=names), dict(zip(NAMES, truth(), strict=True))
    prior = Files(folder or root / "own", **KEYS | keys)
    prior.check(found, tiny_run.WINDOW_SIZE)
    known = [frames.get(name, truth()[0]) for name in names]
    calls = windows(range(len(found)).__contains__, tiny_run.WINDOW_SIZE)
    return len([prior.predict(call, [known[i] for i in call.views], found.intrinsics) for call in calls])


def write_calibrations(root: Path) -> None:
    put("cameras.txt", f"1 PINHOLE 640 480 500.5 502.25 {CORNER}\n")(root)
    put("transforms.json", json.dumps(TRANSFORMS))(root)
    put("vipe.json", json.dumps(OF_VIPE))(root)
    for name, text in {"info": ROS, "orb": ORB, "camchain": KALIBR, "intrinsics": MAST3R}.items():
        put(f"{name}.yaml", text)(root)


OTHER_MODEL = "1 FISHEYE624 640 480 500 500 320 240 0 0 0 0 0 0 0 0\n"
LENS_OF_ROS = "[0.1, -0.2, 1e-3, -0.002, 0.05]"
FOREIGN = [
    ("cameras.txt", OTHER_MODEL, "the camera model FISHEYE624 is not read.*image_undistorter"),
    ("cameras.txt", "", "lines CAMERA_ID MODEL"),
    ("cameras.txt", "1 PINHOLE 640 480 500 500 320\n", "PINHOLE has the parameters fx, fy, cx, cy, got 3"),
    ("cameras.txt", "1 PINHOLE 640 480 500 nan 320 240\n", "fy must be a finite number, got 'nan'"),
    ("cameras.txt", "1 PINHOLE 640.5 480 500 500 320 240\n", "width and height must be pixels"),
    ("cameras.txt", "1 SIMPLE_PINHOLE 9 9 5 4 4\n2 SIMPLE_PINHOLE 9 9 6 4 4\n", "2 different cameras: leave that"),
    ("transforms.json", "{", "damaged or no json"),
    ("transforms.json", "[1]", "must hold keys and values"),
    ("transforms.json", '{"a": 1}', "has none of the keys"),
    ("transforms.json", '{"fl_x": 1, "fl_y": 1, "cx": 1, "cy": 1, "h": 3}', "has no w: add"),
    ("transforms.json", json.dumps(TRANSFORMS | {"k7": 1}), "unknown keys: k7.*remove"),
    ("transforms.json", json.dumps(TRANSFORMS | {"k4": 1}), "OPENCV with k4 is not read"),
    ("transforms.json", json.dumps(TRANSFORMS | {"is_fisheye": True, "p1": 0.1}), "OPENCV_FISHEYE with p1 is not read"),
    (
        "transforms.json",
        json.dumps(TRANSFORMS | {"frames": [{}, {}, {"cx": 3}]}),
        "different cameras: cx is .* in frame 0 and 3 in frame 2.*dataset=images",
    ),
    ("transforms.json", json.dumps(TRANSFORMS | {"fl_x": True}), "fl_x must be a finite number"),
    ("info.yaml", ROS.replace("image_height: 480\n", ""), "has no image_height: add"),
    ("info.yaml", ROS.replace("plumb_bob", "equidistant"), "OPENCV_FISHEYE has k1, k2, k3, k4, got 5 numbers"),
    ("info.yaml", ROS.replace("camera_name", "lens_name"), "unknown keys: lens_name"),
    ("info.yaml", ROS.replace("0, 502.25", "2, 502.25"), "camera_matrix must be fx 0 cx"),
    ("info.yaml", ROS.replace(LENS_OF_ROS, "[0.1, .inf, 0, 0]"), "distortion_coefficients must be a"),
    ("info.yaml", ROS.replace(LENS_OF_ROS, "[0.1, 1, 0]"), "3 distortion coefficients are no k1"),
    ("info.yaml", ROS.replace("plumb_bob", "omni"), "omni is not read, only none, plumb_bob"),
    ("info.yaml", ROS.replace("0.05]", "0.05, 1, 0, 0, 0, 0, 0, 1]"), "12 distortion coefficients are no k1"),
    ("info.yaml", "!!python/object/apply:os.getcwd []", "damaged or no yaml"),
    ("orb.yaml", ORB.replace("PinHole", "KannalaBrandt8"), "OPENCV_FISHEYE with p1, p2 is not read"),
    ("orb.yaml", ORB.replace("Camera.width: 640\n", ""), "has no Camera.width: add"),
    ("orb.yaml", ORB + "Camera2.fx: 3\n", "more than one camera"),
    ("camchain.yaml", KALIBR + KALIBR.replace("cam0:", "cam1:").replace("500.5", "501"), "2 different cameras"),
    ("camchain.yaml", KALIBR.replace("pinhole", "omni"), "the camera model omni is not read, only pinhole"),
    ("camchain.yaml", KALIBR.replace("[640, 480]", "[640]"), "resolution width, height: correct them"),
    ("intrinsics.yaml", MAST3R.replace("width", "widht"), "unknown keys: widht"),
    ("intrinsics.yaml", MAST3R.split("calib")[0] + "calibration: [1, 2, 3]\n", "must be fx, fy, cx, cy.*got 3"),
    ("intrinsics.yaml", MAST3R.split("calib")[0] + "calibration: pinhole\n", r"must have data: \[numbers\]"),
    ("vipe.json", json.dumps(OF_VIPE | {"fx": None}), "fx must be a finite number"),
]


OF_CALIBRATIONS = [((put(name, text), {"file": name}), f"(?s){name}.*{message}") for name, text, message in FOREIGN]


LISTS = [
    ("a.txt", "", "names no class"),
    ("a.txt", "wall\nwall\n", "a.txt names 'wall' twice"),
    ("a.txt", "1 wall\n1 chair\n", "an id stands in it twice"),
    ("a.txt", "1 wall\n2 floor\nceiling\n", "'ceiling' is not: give each an id, or none"),
    ("a.txt", b"\xff\xfe\x00", "a.txt cannot be read"),
    ("a.yaml", "[wall]", "a.yaml is no class file .it is no mapping"),
    ("a.yaml", "class_names_reduced: [wall]", "it lacks map_to_reduced"),
    ("a.yaml", "class_names_reduced: [wall]\nmap_to_reduced: {1: 2}", "says 1: 2, and there are 1 classes"),
    ("a.yaml", "class_names_reduced: wall\nmap_to_reduced: {}", "class_names_reduced is no list"),
    ("a.yaml", "class_names_reduced: [3]\nmap_to_reduced: {}", "3 is no name"),
    ("a.yaml", "a: [", "a.yaml is no class file"),
]
OF_CLASSES = [
    ({"file": "b.txt"}, "class file .*b.txt does not exist: give a name a line"),
    *(((put(name, text), {"file": name}), f"{message}.*: give a name a line") for name, text, message in LISTS),
]


def bag(**options) -> Step:
    """Another bag in the place of the one that is there, see `write_bag`."""

    def run(root):
        shutil.rmtree(root / "walk", ignore_errors=True)
        pytest.importorskip("rosbags", reason="reads bags: pip install -e .[rosbag]")
        from tests.data.written_bag import write_bag

        write_bag(root, **options)

    return run


OF_ROSBAG = [
    ({"root": None}, "give dataset.root=FOLDER"),
    ({"sequence": "run"}, r"has: (\w+)$"),
    ((put("notes/a.txt", ""), {"sequence": "notes"}), "folder of a ROS 2 bag with metadata.yaml"),
    ({"topic": "/eye"}, r"give dataset.(\w+)= one of (\S+)$"),
    ({"info_topic": "/eye"}, r"give dataset.(info_topic)= one of (\S+)$"),
    (bag(others=[{"name": "left"}]), r"dataset.topic= one of (\S+), (\S+)$"),
    (bag(info=False), "no camera_info, so dataset.intrinsics must say the camera"),
    ((bag(encoding="bayer_rggb8", others=[{"name": "rect"}]), {"topic": "/cam/image_raw"}), "'bayer_rggb8',"),
    (
        (bag(model="omni", bent=[0.1] * 4, others=[{"name": "rect"}]), {"topic": "/cam/image_raw"}),
        r"\(a rectified topic needs none of its distortion\).* and give the new calibration",
    ),
    (bag(name="rect", P=np.zeros(12)), "P for the rectified .*: give dataset.intrinsics"),
    (bag(num_cut=9), "is not as large as it says: record it again, or set on_bad_frame=skip"),
    (bag(kind="CompressedImage", num_cut=99), "is damaged: record it again, or set on_bad_frame=skip"),
]


LEFT = np.uint8(255 * (np.indices(EUROC_SIZE[::-1])[1] >= 40))
NAMED = {"names": "{root}/names.txt"}


def write_masked(root: Path) -> None:
    for i in range(3):
        put(f"images/{i}.png", color_image(i, EUROC_SIZE))(root)
        put(f"masks/{i}.png", LEFT)(root)
    put("names.txt", "7 person\n255 cat\n")(root)


def read_masked(root: Path, on_bad_frame: str = "error", **keys) -> float:
    """The share of what is left out of the images that can be read."""
    masks = Masks(**{"folder": str(root / "masks")} | keys)
    found = ReadableFrames(Images(str(root / "images"), intrinsics=SQUARE, size=EUROC_SIZE), on_bad_frame, masks=masks)
    return np.mean([frame.mask for frame in found])


OF_MASKS = [
    (gone("masks/1.png"), r"0 more.: give a folder with one image for each frame, (1\.png)"),
    ({"folder": "{root}/images/masks"}, "no mask for 0 .and 2 more"),
    (resized("masks/1.png", (120, 160)), "it is turned: make it of that size"),
    (resized("masks/1.png", (160, 160)), "but its image is 160x120: make it of"),
    (put("masks/1.png", b"none"), "fetch the file again or set on_bad_frame=skip"),
    ({"classes": ["cat"]}, "masks.names, the file that names the ids"),
    (({"classes": ["dog"]}, NAMED), r"are no classes of .*, (\w+)$"),
    (({"classes": ["cat"]}, NAMED, put("names.txt", "7 person\n9 cat\n")), "give the class file of this data set$"),
]


def recorded(root: Path, name: str = "recording", seed: int = 5, stop: int = 6) -> None:
    data = Named(names=NAMES[:stop])
    record(Simulated(seed=seed, feature_size=4), data, tiny_run.WINDOW_SIZE, root / name)


def read_recorded(root: Path, folder: str = "recording", into: str | None = None, stop: int = 6, size: int = 3) -> int:
    if into is not None:
        recorded(root, into, seed=6)
    prior, data = Recorded(root / folder), Named(names=NAMES[:stop])
    prior.check(data, size)
    calls = windows(range(len(data)).__contains__, size)
    return len([prior.predict(call, [data[i] for i in call.views], data.intrinsics) for call in calls])


MANIFEST, INFERENCE = "recording/manifest.json", "recording/000001.npz"


OF_RECORDED = [
    ({"folder": "."}, "manifest.json is missing: expected the folder of a recording"),
    (put(MANIFEST, "{"), "is damaged .*: record into another folder with .*experiments.predict"),
    (put(MANIFEST, "[]"), "is not of the format .*: record into another folder"),
    (edit(MANIFEST, ('"version": 3', '"version": 2')), "has version 2, .*: record into another folder"),
    (edit(MANIFEST, ('"window_size": 3', '"window_size": 2')), "SHA-256 does not fit.: record into another"),
    (gone(INFERENCE), "000001.npz is missing: .*experiments.predict.* makes what is missing or damaged"),
    ({"size": 4}, "window_size 3, but this run has 4: .* or record into another folder"),
    ({"into": "recording"}, "holds a recording with provenance .*: choose another folder"),
]


DENSE = np.float32(np.random.default_rng(0).uniform(0.1, 1.0, (6, 48, 64)))


def write_dense(root: Path) -> None:
    (root / "npy").mkdir()
    for name, values in zip(NAMES, DENSE, strict=True):
        np.save(root / "npy" / f"{name}.npy", values)


def saved(name: str, **arrays: np.ndarray) -> Step:
    return lambda root: np.savez(root / name, **arrays)


def read_dense(root: Path, folder: str = "npy", names: list[str] = NAMES, **keys) -> bool:
    keys = {"folder": root / folder, "kind": "affine_inverse", "depth_scale": 1000.0} | keys
    way_of_files(SimpleNamespace(**keys)).check(Named(names=names))
    return True


OF_DENSE = [
    ({"folder": "."}, r"it has the folders (\w+): give one of them"),
    ((saved("v.npz", a=DENSE, b=DENSE), {"folder": "v.npz"}), r"has a, b: name the depths one of (\w+),"),
    ((saved("v.npz", depths=DENSE[0]), {"folder": "v.npz"}), r"must be depths \(frames, h, w\) of all frames"),
    (
        tuple(put(f"png/{name}.png", color_image(0, (64, 48))) for name in NAMES) + ({"folder": "png"},),
        r"coloured picture of depth, .*: let the program write values \(--grayscale --pred-only, .* .npy\)",
    ),
    (lambda root: np.save(root / "npy/IMG_8.npy", DENSE[0][:, :48]), "where it was cropped"),
    (gone("npy/IMG_9.npy"), "out .dataset.start, stop"),
    (
        tuple(put(f"npy/{name}_conf.npy", b"") for name in NAMES)
        + tuple(moved(f"npy/{name}.npy", f"npy/{name}_d.npy") for name in NAMES),
        r"several kinds for each frame, \*_conf, \*_d: leave one kind",
    ),
    ({"names": ["a", "b", "c"]}, "or choose the frames that were predicted"),
    ({"depth_scale": 0.0}, "prior.dense.depth_scale must be raw units per metre, above 0"),
]


ENCODER = {"encoder_str": "dinov2", "torch_hub_pretrained": False}


def write_weights(root: Path) -> None:
    put("weights/config.json", json.dumps({"encoder_config": ENCODER}))(root)
    put("weights/model.safetensors", "")(root)
    put(f"hub/{DINOV2_CLONE}/hubconf.py", "")(root)


def read_network(root: Path, folder: str | None = "weights", **keys) -> bool:
    """What `prior=mapanything` looks at before it loads a network: the weights, its keys, the images of a window."""
    check_checkpoint(None if folder is None else root / folder, root / "hub")
    words = [f"prior.{key}={value}" for key, value in ({"resolution": "[56,42]"} | keys).items()]
    data = Sphere(size=(40, 30))
    with clear():
        prior = build(compose("prior=mapanything", *words), "prior", load=lambda *_: network_of(Double(data)))
    return prior.provenance.name == "mapanything"


WEIGHTS = "weights/config.json"


OF_NETWORKS = [
    ({"folder": None}, "is not set: download the weights once .* and name the FOLDER"),
    ({"folder": "hub"}, "config.json and no model.safetensors: prior.checkpoint is the FOLDER"),
    (put(WEIGHTS, "{"), "is no configuration of MapAnything .*: repeat"),
    (
        put(WEIGHTS, json.dumps({"encoder_config": {"encoder_str": "dinov2"}})),
        r'add ("torch_hub_pretrained": false) to its encoder_config',
    ),
    (gone(f"hub/{DINOV2_CLONE}/hubconf.py"), "into that folder once"),
    ({"resolution": "[50,50]"}, r"multiples of (14), or (null)"),
    ({"resolution": "[518]"}, "must be .width, height. in multiples of 14"),
    ({"anchor_pose": "maybe"}, r"must be (on) or (off)"),
    ({"compute.amp": "fp8"}, "must be one of bf16, fp16, (float32)"),
]


@contextmanager
def clear() -> Iterator[None]:
    """What Hydra makes of an error, as a command says it."""
    try:
        yield
    except InstantiationException as error:
        raise ValueError(message_of(error)) from error


def write_model(root: Path, name: Callable[[int], str] = "{:02}.png".format) -> None:
    """COLMAP's model of the images of a synthetic scene."""
    from tests.structure.test_models import scene as synthetic

    scene = synthetic()
    for row, image in enumerate(scene.images.values()):
        image.name = name(row)
    (root / "model").mkdir(exist_ok=True)
    scene.write_binary(root / "model")


def named_model(name: Callable[[int], str]) -> Step:
    return lambda root: write_model(root, name)


def read_structure(root: Path, words: Sequence[str] = (), model: str = "model", names: Sequence[str] = ()) -> int:
    """What `prior=multiview_stereo` makes of words and of a given model before it looks at images."""
    with clear():
        given = compose("prior=multiview_stereo", f"prior.structure.model='{root / model}'", *words)
        config = build(given, "prior.structure", _convert_="all")
    member("FeatureExtractorType", config.features, "features")
    matcher_of(config)
    options_of("FeatureExtractionOptions", config.options.get("extraction", {}))
    names = names or [f"{row:02}" for row in range(8)]
    taken = Shots(names, None, (160, 120), ("PINHOLE", (1, 1, 1, 1)), True)
    return given_models(root / model, taken, config)[0].num_reg_images()


OPTION = "+prior.structure.options"


OF_STRUCTURE = [
    ({"words": [f"{OPTION}.sift.max_num_features=99"]}, r"there are (extraction)\.KEY="),
    ({"words": [f"{OPTION}.extraction.max_size=99"]}, r"its options are .*\b(max_image_size)\b"),
    ({"words": ["prior.structure.mapper=hybrid"]}, "must be one of incremental, (global)"),
    ({"words": ["prior.structure.features=superpoint"]}, "pycolmap has (sift)"),
    ({"words": ["prior.structure.matcher=flann"]}, r"pycolmap has .*\b(sift_bruteforce)"),
    ({"model": "nowhere"}, "does not exist: give the folder of a COLMAP model"),
    ((put("empty/a", ""), {"model": "empty"}), "empty holds no model of COLMAP"),
    ((put("empty/database.db", "x"), {"model": "empty"}), "is no database of COLMAP, or a dam"),
    (lambda root: (root / "model/points3D.bin").write_bytes(b"x"), "is damaged: .*export the model again"),
    ({"names": ["0", "1", "2"]}, "it has 00, 01, 02, …, this run 0, 1, 2, …; names count without folder and suffix"),
    (named_model(lambda row: f"cam{row % 2}/{row // 2:02}.png"), "has two images 00"),
]


TABLES = {
    "apartment": (lambda root: None, lambda root, **keys: len(Apartment(**keys)), OF_APARTMENT),
    "bonn": (write_tum, frames(Bonn, sequence=TUM), OF_BONN),
    "rosbag": (lambda root: bag()(root), frames(RosBag, sequence="walk", size=[160, 120]), OF_ROSBAG),
    "masks": (write_masked, read_masked, OF_MASKS),
    "recorded": (recorded, read_recorded, OF_RECORDED),
    "dense": (write_dense, read_dense, OF_DENSE),
    "networks": (write_weights, read_network, OF_NETWORKS),
    "structure": (write_model, read_structure, OF_STRUCTURE),
    "tum": (write_tum, frames(Tum, sequence=TUM), OF_TUM),
    "seven_scenes": (write_seven_scenes, frames(SevenScenes, sequence=SEVEN), OF_SEVEN),
    "replica": (write_replica, frames(Replica, sequence="office9"), OF_REPLICA),
    "kitti": (write_kitti, frames(Kitti, sequence="07"), OF_KITTI),
    "euroc": (write_euroc, frames(Euroc, sequence="MH_01_easy"), OF_EUROC),
    "colmap": (write_colmap, frames(Colmap), OF_COLMAP),
    "nerfstudio": (write_nerfstudio, frames(Nerfstudio), OF_NERFSTUDIO),
    "images": (write_folder, frames(Images, intrinsics=SQUARE), OF_IMAGES),
    "clip": (write_clip, frames(Images, sequence="clip.avi", intrinsics=SQUARE), OF_CLIP),
    "predictions": (lambda root: write_npz(root / "own", NAMES), read_own, OF_PREDICTIONS),
    "calibration": (write_calibrations, lambda root, file: read_calibration(root / file), OF_CALIBRATIONS),
    "classes": (lambda root: None, lambda root, file: read_classes(root / file), OF_CLASSES),
}


@pytest.mark.parametrize("name", TABLES)
def test_each_message_says_what_is_wrong_and_what_to_do(name, tmp_path):
    check_messages(tmp_path, *TABLES[name])

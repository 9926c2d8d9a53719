"""Advice helps: the cause of a message is made, the message read and what it says done, after which the same works.

A row is a cause, the message, and remedies, each of which is tried by itself on files that are sound but for the cause.
"""

import json
import re
import shutil
import subprocess
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tiny_run
import yaml
from omegaconf import OmegaConf
from PIL import ExifTags, Image

from emgs_jax.config.configure import compose
from emgs_jax.data.calibration_files import read_calibration
from emgs_jax.data.checksums import SUMS_FILE, WRITE
from emgs_jax.data.class_file import read_classes
from emgs_jax.data.euroc import Euroc
from emgs_jax.data.images import Images
from emgs_jax.data.kitti import Kitti
from emgs_jax.data.posed_images import Colmap, Nerfstudio
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.data.replica import Replica
from emgs_jax.data.seven_scenes import SevenScenes
from emgs_jax.data.tum import Tum
from emgs_jax.io.files import jsonable
from emgs_jax.io.ply import save_points_ply
from emgs_jax.io.trajectory import save_trajectory_tum
from emgs_jax.prior.base import windows
from emgs_jax.prior.files.prior import Files
from emgs_jax.report.provenance import RESULT_FORMAT
from emgs_jax.report.results import METRICS_FILE, is_finished
from experiments.evaluate import plan
from experiments.export import export_run
from experiments.grid import read_axes, variants
from experiments.query import query
from experiments.score import score
from experiments.search import read_objectives, read_space
from tests.data.test_calibration_files import CORNER, KALIBR, MAST3R, ORB, ROS, TRANSFORMS
from tests.data.test_calibration_files import PLAIN as OF_VIPE
from tests.data.written_benchmarks import CAMERAS, EUROC_SIZE, write_colmap, write_euroc, write_kitti, write_nerfstudio
from tests.data.written_scene import color_image, write_replica, write_seven_scenes, write_tum
from tests.prior.files.written_predictions import KEYS, NAMES, Named, truth, write_depths, write_npz
from tests.report.written_run import written_run
from tests.scripts.test_score import SIMILARITY, room, write_system

Said = re.Match | None
Step = Mapping[str, Any] | tuple | Callable[[Path, Said], Any]


def done(step: Step, root: Path, said: Said = None) -> dict[str, Any]:
    """Options of the reader after a step: those it is, those of its parts, or none of a function that changes files.

    A text may name `{root}`, and by its number a part of what the message said.
    """
    if isinstance(step, tuple):
        return {key: value for part in step for key, value in done(part, root, said).items()}
    if callable(step):
        step(root, said)
        return {}
    words = () if said is None else (said[0], *said.groups())
    filled = {key: value.format(*words, root=root) for key, value in step.items() if isinstance(value, str)}
    return {**step, **{key: yaml.safe_load(value) for key, value in filled.items()}}


def edit(file: str, *pairs: tuple[str, str]) -> Step:
    """Replace parts of a text, each of which must be there."""

    def run(root, said):
        text = (root / file).read_text()
        for old, new in pairs:
            assert old in text, f"{old} is not in {file}"
            text = text.replace(old, new, 1)
        (root / file).write_text(text)

    return run


def lines(file: str, change: Callable[[list[str]], list[str]]) -> Step:
    """Change the words of each line that is no comment; without any it is gone."""

    def run(root, said):
        text = (root / file).read_text()
        found = [line if line.startswith("#") else " ".join(change(line.split())) for line in text.splitlines() if line]
        (root / file).write_text("\n".join(filter(None, found)) + "\n")

    return run


def put(file: str, content: str | bytes | np.ndarray) -> Step:
    def run(root, said):
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        data = cv2.imencode(Path(file).suffix, content)[1].tobytes() if isinstance(content, np.ndarray) else content
        (root / file).write_bytes(data if isinstance(data, bytes) else data.encode())

    return run


def gone(file: str) -> Step:
    return lambda root, said: (root / file).unlink()


def moved(file: str, to: str) -> Step:
    def run(root, said):
        (root / to).parent.mkdir(parents=True, exist_ok=True)
        (root / file).rename(root / to)

    return run


def fetched(file: str) -> Step:
    """The file as it was."""
    return lambda root, said: shutil.copy(root.parent / "sound" / file, root / file)


def resized(file: str, size: tuple[int, int]) -> Step:
    def run(root, said):
        image = cv2.imread(str(root / file), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(root / file), cv2.resize(image, size, interpolation=cv2.INTER_NEAREST))

    return run


def frames(build: Callable, **defaults) -> Callable[..., int]:
    """A reader of all frames of a data set."""

    def read(folder: Path, **options) -> int:
        given = {"root": str(folder), "stride": 1} | defaults | options
        reading = {key: given.pop(key) for key in ("on_bad_frame", "checksums") if key in given}
        return len([*ReadableFrames(build(**given), **reading)])

    return read


SKIP = {"on_bad_frame": "skip"}
TUM, FR3 = "rgbd_dataset_freiburg3_plane", [535.4, 539.2, 320.1, 247.6]
COLOR, DEPTH, TRUTH = f"{TUM}/rgb/101.000000.png", f"{TUM}/depth/101.010000.png", f"{TUM}/groundtruth.txt"
IMAGES = [f"{TUM}/{kind}/{100 + i + late:.6f}.png" for i in range(3) for kind, late in (("rgb", 0), ("depth", 0.01))]
LABEL, CLASSES = f"{TUM}/semantic/101.000000.png", f"{TUM}/classes.txt"
WALL = np.full((480, 640), 4, np.uint16)
LABELS = (
    *(put(f"{TUM}/semantic/{100 + i:.6f}.png", WALL) for i in range(3)),
    *(put(CLASSES, "4 wall\n300 cup\n"), {"labels": "semantic"}),
)
LINE = r"groundtruth.txt, line 3: .*: correct the line or take it out .* or set on_bad_frame=skip"
NO_LINE = lines(TRUTH, lambda words: words * (words[0] != "100.9950"))
COMMAND = r" \((?P<command>cd FOLDER .*? > SHA256SUMS)\)"


def shifted(time: float = 0.0, x: float = 0.0) -> Step:
    """The true path at other times or elsewhere."""
    return lines(TRUTH, lambda words: [f"{float(words[0]) + time:.4f}", str(float(words[1]) + x), *words[2:]])


def listed(root: Path, said: Said) -> None:
    """The command that writes checksums, as a message says it where there is one."""
    command = WRITE if said is None else said["command"]
    subprocess.run(command.replace("FOLDER", f"'{root / TUM}'"), shell=True, check=True)


OF_TUM = [
    ({"root": None}, "give dataset.root=FOLDER", {"root": "{root}"}),
    ({"sequence": None}, "give dataset.sequence=NAME", {"sequence": TUM}),
    ({"sequence": "fr3"}, r"has: (\w+)$", {"sequence": "{1}"}),
    ({"start": 3}, r"start must be in 0\.\.(\d),", {"start": "{1}"}),
    ({"stop": 9}, r"null \(all\) or in 1\.\.(\d),", {"stop": None}, {"stop": "{1}"}),
    ({"stop": 0}, r"null \(all\) or in (\d)\.\.3,", {"stop": "{1}"}),
    ({"stride": 0}, r"must be at least (\d)", {"stride": "{1}"}),
    ({"start": 0.5}, "must be a whole number of images", {"start": 0}),
    ({"size": [320]}, r"must be \[width, height\] in pixels", {"size": [320, 240]}),
    ({"depth_scale": 0}, r"raw units per metre \((\d+) for TUM\)", {"depth_scale": "{1}"}),
    ({"intrinsics": [1070.8, 1078.4, 640.7, 495.7]}, "at the size of the images on disk", {"intrinsics": FR3}),
    ({"intrinsics": [500, 0, 320, 240]}, "must be .fx, fy, cx, cy.", {"intrinsics": FR3}),
    (
        {"intrinsics": [*FR3, 0.1]},
        r"must be \[fx, fy, cx, cy\], or \[fx, fy, cx, cy, k1, k2, p1, p2\(, k3\(, k4, k5, k6\)\)\] .* or \[MODEL, …\]",
        *({"intrinsics": [*FR3, *lens]} for lens in ((), (0.1, 0, 0, 0), (0.1, 0, 0, 0, 0), (0.1, *[0] * 7))),
        {"intrinsics": ["PINHOLE", *FR3]},
    ),
    ({"intrinsics": [*FR3, 0.1, -900, 0, 0]}, "check the order .OPENCV", {"intrinsics": [*FR3, 0.1, -0.2, 0, 0]}),
    (
        (moved(TUM, "desk"), {"sequence": "desk"}),
        r"names no calibration.*: give dataset.intrinsics=\[fx,fy,cx,cy\] .* k1,k2,p1,p2 and maybe k3 .* \[MODEL,…\]",
        *({"intrinsics": [*FR3, *lens]} for lens in ((), (0.1, 0, 0, 0), (0.1, 0, 0, 0, 0))),
        {"intrinsics": ["SIMPLE_RADIAL", 535.4, 320, 240, 0.1]},
    ),
    ({"distortion": [0.1, *[0] * 4]}, "needs the dataset.intrinsics", {"intrinsics": FR3}),
    ({"intrinsics": FR3, "distortion": [0.1]}, r"must be \[k1, k2, p1, p2, k3\]", {"distortion": [0.1, *[0] * 4]}),
    (
        {"intrinsics": [*FR3, *[0] * 4], "distortion": [0.1, *[0] * 4]},
        r"goes with dataset.intrinsics=\[fx,fy,cx,cy\] only: put it behind them",
        *({"intrinsics": FR3}, {"intrinsics": [*FR3, 0.1, *[0] * 4], "distortion": None}),
    ),
    (gone(COLOR), "is missing: fetch the file again or set on_bad_frame=skip", fetched(COLOR), SKIP),
    (
        put(COLOR, b"\0\0\0\x18ftypheic" + bytes(99)),
        "HEIC.*: convert it to png or jpg, .* or set on_bad_frame=skip",
        *(put(COLOR, color_image(1, (640, 480))), SKIP),
    ),
    (put(COLOR, b"version https://git-lfs.github.com"), "Git LFS .*git lfs pull fetches it", fetched(COLOR)),
    (put(DEPTH, np.zeros((480, 640), np.uint8)), "must be a 16-bit depth image", fetched(DEPTH), SKIP),
    (
        resized(COLOR, (320, 240)),
        "resize the file, or .*, or set on_bad_frame=skip",
        *(resized(COLOR, (640, 480)), SKIP),
    ),
    (
        tuple(resized(image, (320, 240)) for image in IMAGES),
        "is 320x240, .* or give dataset.intrinsics for the images that are there",
        {"intrinsics": [267.7, 269.6, 159.8, 123.55]},
    ),
    (edit(TRUTH, ("100.9950 0.04", "100.9950 x")), LINE, fetched(TRUTH), NO_LINE, SKIP),
    (lines(TRUTH, lambda words: [*words[:-1], "9" * (words[0][1] == "0") + words[-1]]), LINE, fetched(TRUTH)),
    (edit(TRUTH, ("0.01 0.02 0 0.0", "0.01 0.02 0 9e200 0.0")), "line 3: .* has not length 1: correct", fetched(TRUTH)),
    (edit(TRUTH, (" 0 0.99", "")), "groundtruth.txt, line 3: expected a timestamp and 7 more", fetched(TRUTH)),
    (edit(f"{TUM}/rgb.txt", ("\n101", "\nx01")), "rgb.txt, line 3: expected a timestamp", fetched(f"{TUM}/rgb.txt")),
    (shifted(x=4.5e5), "subtract one position from all of its lines", shifted(x=-4.5e5)),
    (edit(TRUTH, ("9950 0.04", "9950 9900")), "line 3: has a position of .*, else correct this one", fetched(TRUTH)),
    (
        edit(TRUTH, ("9950 0.04", "9950 400")),
        "correct the trajectory, or write nan where the pose is not known",
        *(fetched(TRUTH), edit(TRUTH, ("9950 400", "9950 nan"))),
    ),
    (shifted(x=np.nan), "0 of 3 images have a true pose: fetch the trajectory again", fetched(TRUTH)),
    (
        (edit(TRUTH, ("99.9950 0.0", "99.9950 nan")), {"stop": 1}),
        r"or choose other images \(dataset.start, stop, stride\)",
        *({"stop": 3}, {"start": 1, "stop": 2}),
    ),
    (
        shifted(time=0.5),
        "at 100.000 .*Correct the times, .* raise dataset.max_time_difference, or move the file away",
        *(shifted(time=-0.5), {"max_time_difference": 0.6}, moved(TRUTH, "away.txt")),
    ),
    (
        (lines(TRUTH, lambda words: words * (words[0] != "99.9950")), {"stop": 1}),
        r"choose other images \(dataset.start, stop\)",
        {"stop": None},
    ),
    (put(TRUTH, "# nothing\n"), "0 of 3 images have a pose .*lines of this file at no s", fetched(TRUTH)),
    (
        edit(f"{TUM}/depth.txt", *((f"\n10{i}", f"\n50{i}") for i in range(3))),
        "0 of 3 images have a depth .* at 100.000 to 102.000 s, .* at 500.010 to 502.010 s",
        *(fetched(f"{TUM}/depth.txt"), moved(f"{TUM}/depth.txt", "away.txt")),
    ),
    ({"max_time_difference": -1}, "must be seconds, 0 or more", {"max_time_difference": 0.02}),
    ((LABELS, {"labels": "classes"}), "is no folder: give one with a class image", {"labels": "semantic"}),
    ((LABELS, put(LABEL, np.zeros((4, 4, 3), np.uint8))), "write the ids, not their colours", put(LABEL, WALL)),
    ((LABELS, put(LABEL, np.uint8(WALL + 40))), "write it with 16 bits", put(LABEL, WALL + 296)),
    (
        (LABELS, put(LABEL, WALL + 3)),
        "give the class file of this data set, or say with `unknown` which ids mean no class",
        *({"unknown": [0, 7]}, put(CLASSES, "4 wall\n7 cup\n")),
    ),
    ((LABELS, {"unknown": "7"}), "must be a list of ids, whole numbers from 0", {"unknown": [0]}),
    (
        (listed, edit(TRUTH, ("100.9950 0.04", "100.9950 0.05")), {"checksums": "auto"}),
        f"fetch the file again, write the list again if it is right{COMMAND}, or set on_bad_frame=skip",
        *(fetched(TRUTH), listed, {"checksums": "off"}),
    ),
    ((listed, put(COLOR, color_image(2, (640, 480))), {"checksums": "auto"}), "or set on_bad_frame=skip", SKIP),
    (
        (put(f"{TUM}/rgb/{SUMS_FILE}", "0" * 64 + "  x.png\n"), {"checksums": "auto"}),
        f"lacks 3 of the 3 images in use, .*: write it again{COMMAND}, or set checksums=off",
        *((gone(f"{TUM}/rgb/{SUMS_FILE}"), listed), {"checksums": "off"}),
    ),
    (
        (put(f"{TUM}/{SUMS_FILE}", "x"), {"checksums": "auto"}),
        f"expected 64 hexadecimal digits.*; write the list again{COMMAND}",
        listed,
    ),
    ({"checksums": "nowhere"}, "give the file, auto or off", {"checksums": "auto"}, {"checksums": "off"}),
    ({"on_bad_frame": "maybe"}, "must be error or skip", {"on_bad_frame": "error"}, SKIP),
]

SEVEN = "kitchen/seq-01"
POSE = f"{SEVEN}/frame-000001.pose.txt"
PSEUDO = "seq-01/frame-000000.color.png 1 0 0 0 0 0 0 525\n"


def turned(*diagonal: float) -> Step:
    """The first three columns of a pose times numbers, or by what a message says."""

    def run(root, said):
        pose = np.loadtxt(root / POSE)
        np.savetxt(root / POSE, pose * [*(diagonal or [1 / float(said[1])] * 3), 1.0])

    return run


OF_SEVEN = [
    (turned(2, 2, 2), "a rotation times (2), .*: divide the first three columns by it", turned()),
    (turned(1, -1, 1), "a mirrored pose, .*: flip two of them, or none", turned(1, 1, -1), turned(1, -1, 1)),
    (turned(1, 1, 0.5), "is no rigid motion: fetch the file again or set on_bad_frame=skip", fetched(POSE), SKIP),
    (edit(POSE, (" ", " x ")), "must hold 16 numbers .*: fetch the file again or set", fetched(POSE), SKIP),
    (
        {"register_depth": False, "intrinsics": [585, 585, 320, 240, 0.1, 0, 0, 0]},
        "set dataset.register_depth=true",
        {"register_depth": True},
    ),
    (
        (put("p.txt", PSEUDO.replace("01", "09")), {"poses": "{root}/p.txt"}),
        "has no line of seq-01: give the list of its scene",
        put("p.txt", PSEUDO),
    ),
    (
        (put("p.txt", PSEUDO.replace("1 0", "x 0")), {"poses": "{root}/p.txt"}),
        "line 1 is no pose of the form seq-XX/frame-000000.color.png qw qx qy qz tx ty tz focal",
        put("p.txt", PSEUDO),
    ),
]

CAM, TRAJECTORY = "cam_params.json", "office9/traj.txt"
OF_REPLICA = [
    (edit(CAM, ('"w"', '"width"')), 'must hold {"camera": {w, h, fx, fy, cx, cy, scale}}', fetched(CAM)),
    (
        (edit(TRAJECTORY, ("\n", "\n\n")), {"stop": 2}),
        "blank lines among its poses.*: take the lines out, or where an image has no pose write 16 times nan",
        *(fetched(TRAJECTORY), edit(TRAJECTORY, ("\n\n", f"\n{'nan ' * 16}\n"))),
    ),
    (put(TRAJECTORY, "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n"), "1 poses, .*: fetch traj.txt again", fetched(TRAJECTORY)),
]

TIMES, POSES, CALIB = "sequences/07/times.txt", "poses/07.txt", "sequences/07/calib.txt"
OF_KITTI = [
    (edit(TIMES, ("2.074e-01\n", "")), "2 lines for 3 images: fetch the sequence and this file again", fetched(TIMES)),
    (edit(TIMES, ("0", "x")), "times.txt, line 1: must be 1 finite numbers.*: fetch it again", fetched(TIMES)),
    (edit(POSES, (" ", " x ")), "07.txt, line 1: .* must be 12 numbers.*: fetch the file again", fetched(POSES)),
    (edit(POSES, ("1.0", "3.0")), "07.txt, line 1: has a pose that is no rigid motion: fetch", fetched(POSES)),
    (edit(CALIB, ("P2", "P9")), "has no P2: fetch the calibration files", fetched(CALIB)),
    (edit(CALIB, ("P2: 9.2", "P2: -9.2")), "P2 must be that of a rectified camera.*: fetch it again", fetched(CALIB)),
    ({"camera": 0}, r"image_0 is no folder; expected the layout root/\{sequences/00/\{image_(2)", {"camera": "{1}"}),
    (gone(TIMES), "times.txt is missing", fetched(TIMES)),
    ({"sequence": 9}, "sequences/09 does not exist; expected .*KITTI.* has: (07)", {"sequence": "{1}"}),
]

MAV = "MH_01_easy/mav0"
SENSOR, STATES = f"{MAV}/cam0/sensor.yaml", f"{MAV}/state_groundtruth_estimate0/data.csv"
OF_EUROC = [
    (edit(SENSOR, ("T_BS:", "T_SB:")), "has no T_BS, .*: fetch it again", fetched(SENSOR)),
    (
        edit(SENSOR, ("radial-tangential", "omni")),
        "omni is not read, only none, .*: undistort .* and give the new",
        edit(SENSOR, ("omni", "none"), ("coefficients: [-0.02, 0.004, 0.001, -0.002]", "coefficients: []")),
    ),
    (
        {"camera": "cam1"},
        r"cam1/data.csv is missing; expected the layout root/SEQUENCE/mav0/\{(cam0)",
        {"camera": "{1}"},
    ),
    ({"max_time_difference": 1e-4}, "0 of 3 images have a pose", {"max_time_difference": 2e-3}, gone(STATES)),
    (edit(SENSOR, ("[160, 120]", "[752, 480]")), "is for images of 752x480, .*: give the calibration", fetched(SENSOR)),
    (edit(SENSOR, ("[160, 120]", "752")), r"resolution must have data: \[numbers\]: correct it", fetched(SENSOR)),
    (edit(STATES, *[(",0.", ",7.")] * 4), "line 2: .*: correct the line or take it out", fetched(STATES)),
]

CAMERA, MODEL = "sparse/0/cameras.txt", "sparse/0/images.txt"
FIRST, SECOND = (f"{i} PINHOLE 160 120 {CAMERAS['PINHOLE'][0]}\n".replace("130", f"1{i - 4}0") for i in (7, 8))
OF_COLMAP = [
    (
        edit(CAMERA, ("160 120", "320 240")),
        "give the calibration of these images, or these images in that size",
        fetched(CAMERA),
        tuple(resized(f"images/img{number}.png", (320, 240)) for number in (2, 10, 33)),
    ),
    (edit(CAMERA, ("160 120", "120 160")), "calibrate the images as they are shown", fetched(CAMERA)),
    (edit(CAMERA, ("\n7 ", "\n7 SIMPLE 1\n8 ")), "cameras.txt:2: expected CAMERA_ID MODEL", fetched(CAMERA)),
    (edit(CAMERA, ("PINHOLE", "KANNALA")), "KANNALA is not read.*image_undistorter", fetched(CAMERA)),
    (edit(MODEL, (" 7 img33", " 8 img33")), "of camera 8, which has no line: export the model again", fetched(MODEL)),
    (edit(MODEL, ("img2.png", "img10.png")), "has img10.png twice: export the model again", fetched(MODEL)),
    (
        edit(MODEL, ("img2.png\n\n", "img2.png\n")),
        "images.txt:5: expected .* or an empty line, .*: every image has two lines",
        edit(MODEL, ("img2.png\n", "img2.png\n\n")),
    ),
    (edit(MODEL, ("\n4 0", "\n4 7")), "images.txt:4: the pose is not finite .*: export the model", fetched(MODEL)),
    (edit(MODEL, ("img10.png", "")), "images.txt:2: expected IMAGE_ID QW.*: export the model again", fetched(MODEL)),
    (
        (put(CAMERA, FIRST + SECOND), edit(MODEL, (" 7 img33", " 8 img33"))),
        "2 different cameras: map those of one, or run COLMAP with --ImageReader.single_camera 1",
        lines(MODEL, lambda words: words * ("img33.png" not in words)) and edit(MODEL, (" 8 img33", " 7 img33")),
        put(CAMERA, FIRST + FIRST.replace("7", "8", 1)),
    ),
    ({"images": "photos"}, "none of them is in .*photos: put the images there", moved("images", "photos")),
    ({"model": "here"}, "no cameras and images .* in .*here", moved("sparse/0", "here"), {"model": None}),
    (
        put(MODEL, "# nothing\n"),
        "has no images with a pose: register some, or give another model",
        *(
            fetched(MODEL),
            (put("1/cameras.txt", FIRST), put("1/images.txt", "3 1 0 0 0 0 0 0 7 img2.png\n\n"), {"model": "'1'"}),
        ),
    ),
    (gone(MODEL), r"no cameras and images \(.txt or .bin\)", fetched(MODEL)),
    (
        (moved(CAMERA, f"{CAMERA[:-3]}bin"), moved(MODEL, f"{MODEL[:-3]}bin")),
        r"cameras.bin is damaged: .*export",
        tuple(moved(f"{file[:-3]}bin", file) for file in (CAMERA, MODEL)),
    ),
    (gone("images/img2.png"), "is missing: fetch the file again or set on_bad_frame=skip", SKIP),
]


def transforms(**changes) -> Step:
    def run(root, said):
        values = json.loads((root / "transforms.json").read_text()) | changes
        (root / "transforms.json").write_text(json.dumps({k: v for k, v in values.items() if v is not None}))

    return run


FRAME = {"file_path": "images/img2.png", "transform_matrix": np.eye(4).tolist()}
AGAIN = fetched("transforms.json")
OF_NERFSTUDIO = [
    (gone("transforms.json"), "transforms.json does not exist; expected the layout", AGAIN),
    (transforms(frames=[FRAME | {"transform_matrix": [["x"] * 4] * 4}]), "must hold frames with", AGAIN),
    (transforms(frames=[]), "has no frames: export it again", AGAIN),
    (transforms(frames=[{"file_path": "images/img2.png"}]), "must hold frames with .*: export it again", AGAIN),
    (transforms(frames=[FRAME | {"transform_matrix": [[1, 0], [0, 1]]}]), "4 rows of 4: export it again", AGAIN),
    (transforms(frames=[FRAME | {"transform_matrix": np.ones((4, 4)).tolist()}]), "is no rigid motion", AGAIN),
    (transforms(frames=[FRAME, FRAME]), "has images/img2.png twice: export it again", AGAIN),
    (transforms(w=320, h=240), "is for images of 320x240, .*: give the calibration of these images", AGAIN),
    (transforms(fl_x=None), "has no fl_x: add what is missing, in pixels of the images", transforms(fl_x=130)),
    (
        transforms(frames=[FRAME, FRAME | {"file_path": "images/img10.png", "fl_x": 99}]),
        "different cameras: .*: take images of one camera",
        transforms(frames=[FRAME, FRAME | {"file_path": "images/img10.png"}]),
    ),
]

SIZE, SQUARE = EUROC_SIZE, [128, 128, 79.5, 59.5]
PLAIN = '{"width": 160, "height": 120, "fx": 128, "fy": 128, "cx": 79.5, "cy": 59.5}'
CAMERA_FILE = (put("camera.json", PLAIN), {"intrinsics": "{root}/camera.json"})


def write_folder(root: Path) -> None:
    for i in range(3):
        put(f"{i}.png", color_image(i, SIZE))(root, None)


def photos(*numbers: int, **exif) -> Step:
    """JPEGs, with EXIF tags by name; of what had that name nothing is left."""

    def run(root, said):
        tags = Image.Exif()
        for name, value in exif.items():
            tags.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base[name]] = value
        for i in numbers or range(3):
            (root / f"{i}.png").unlink(missing_ok=True)
            Image.fromarray(color_image(i, SIZE)).save(root / f"{i}.jpg", exif=tags)

    return run


OF_IMAGES = [
    (
        {"intrinsics": None},
        "in pixels of the images on disk .*, a calibration file, exif .*fx = fy = .8 times the width and the centre",
        *({"intrinsics": SQUARE}, CAMERA_FILE, {"intrinsics": [0.8 * 160, 0.8 * 160, 80, 60]}),
        (photos(FocalLengthIn35mmFilm=26), {"intrinsics": "exif"}),
    ),
    *(
        (
            (photos(**tags), {"intrinsics": "exif"}),
            "0.jpg has no EXIF FocalLengthIn35mmFilm.*: give dataset.intrinsics=",
            *({"intrinsics": SQUARE}, photos(FocalLengthIn35mmFilm=26)),
        )
        for tags in ({}, {"FocalLength": 4.2}, {"FocalLengthIn35mmFilm": 0})
    ),
    (
        (photos(FocalLengthIn35mmFilm=26), photos(2, FocalLengthIn35mmFilm=50), {"intrinsics": "exif"}),
        "several focal lengths .*: take those of one",
        {"stop": 2},
    ),
    (
        (photos(FocalLengthIn35mmFilm=26, ExifImageWidth=4032, ExifImageHeight=2268), {"intrinsics": "exif"}),
        "cut to 160x120, so its EXIF is of another view: give dataset.intrinsics=",
        {"intrinsics": SQUARE},
    ),
    *(
        ({"intrinsics": given}, rf"they fit as those {words}: give (\[.*?\])", {"intrinsics": "{1}"})
        for given, words in (
            ([0.8, 1.0667, 0.5, 0.5], "normalised by width and height"),
            ([128, 79.5, 128, 59.5], "in the order fx, cx, fy, cy"),
            ([64, 64, 39.5, 29.5], "of images of 80x60"),
        )
    ),
    (
        {"intrinsics": [64, 64, 39.5, 29.5]},
        "or, where they are right, a calibration file with width and height",
        (CAMERA_FILE, edit("camera.json", ("128", "64"), ("128", "64"), ("79.5", "39.5"), ("59.5", "29.5"))),
    ),
    ({"intrinsics": [4, 4, 79.5, 59.5]}, "give fx, fy, cx, cy in pixels of the images on disk", {"intrinsics": SQUARE}),
    ({"intrinsics": "{root}/camera.xml"}, "is none of the calibration files that are known: .* JSON with", CAMERA_FILE),
    ({"intrinsics": "{root}/camera.json"}, "camera.json cannot be read; it may be .* JSON with width", CAMERA_FILE),
    (
        tuple(put(f"{i}_mask.png", color_image(i, SIZE)) for i in range(3)),
        "same numbers, such as 0.png and 0_mask.png: .* move the others .* into another folder",
        tuple(moved(f"{i}_mask.png", f"masks/{i}.png") for i in range(3)),
    ),
    (
        tuple(moved(f"{i}.png", f"rgb/{i}.png") for i in range(3)),
        r"it has the folders (\w+): give one of them",
        {"sequence": "{1}"},
    ),
    (
        tuple(moved(f"{i}.png", f"{i}.heic") for i in range(3)),
        "3 .heic, which are not read: convert them to jpg or png",
        photos(),
    ),
    (
        tuple(put(f"{i}.png", b"\0\0\0\x18ftypheic" + bytes(99)) for i in range(3)),
        "HEIC.*: convert it to png or jpg",
        photos(),
    ),
    ({"root": "{root}/0.png"}, "is neither a folder nor a video file", {"root": "{root}"}),
]


def write_clip(root: Path) -> None:
    writer = cv2.VideoWriter(str(root / "clip.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, SIZE)
    for i in range(6):
        writer.write(color_image(i, SIZE))
    writer.release()


OF_CLIP = [
    ({"intrinsics": "exif"}, "a video has no EXIF: give dataset.intrinsics=", {"intrinsics": SQUARE}),
    (put("clip.avi", b""), "clip.avi is empty: copy it again", fetched("clip.avi")),
    (
        put("clip.avi", b"x" * 999),
        "no video that OpenCV can open: convert it to mp4 .h264. or to images",
        *(fetched("clip.avi"), (lambda root, said: write_folder(root), {"sequence": None})),
    ),
]


def own(suffix: str = ".npz", **changes) -> Step:
    """Predictions of the tiny room in own/, anew; `changes`: see `write_npz`."""

    def run(root, said):
        shutil.rmtree(root / "own", ignore_errors=True)
        write_npz(root / "own", NAMES, **changes) if suffix == ".npz" else write_depths(root / "own", suffix)

    return run


def listed_poses(count: int = 6) -> Step:
    return lambda root, said: save_trajectory_tum(
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


def unseen(frame) -> np.ndarray:
    """Where the right half was cropped away."""
    return np.where(np.arange(frame.depth.shape[1]) < 48, frame.depth, 0)


INVERSE, FLIP = np.linalg.inv, [1, -1, -1, 1]
OF_PREDICTIONS = [
    ({"folder": "{root}"}, r"has no file \*.npz, .* and no known layout \(docs", {"folder": "{root}/own"}),
    ({"folder": "{root}/nowhere"}, "does not exist: give the folder of predictions", {"folder": "{root}/own"}),
    (own(T_world_camera=None), "npz lacks T_world_camera; it has depth", own(), named_poses()),
    (own(depth=None), "must have depth or points, one of them", own()),
    (own(depth=lambda frame: frame.depth.ravel()), r"depth must be \(h, w\)", own()),
    (
        own(depth=lambda frame: frame.depth[:, :48]),
        "where it was cropped, write it onto the whole image with 0 where nothing is known",
        own(depth=unseen),
    ),
    (
        in_unit(1000, 1000),
        "no depth in metres: write metres, .* or prior.scale=arbitrary",
        own(),
        {"scale": "arbitrary"},
    ),
    (
        (own(".png"), listed_poses(), {"depth_scale": 1.0}),
        r"give prior.depth_scale \(units of a metre in .png files; (1000): mm\)",
        {"depth_scale": "{1}"},
    ),
    (in_unit(1, 1000), r"the positions by (0\.001)", in_unit(1, 1)),
    (pose_of(lambda T: T * [2, 2, 2, 1]), "no rigid motion within 1e\\+06: camera -> world is expected", own()),
    (pose_of(INVERSE), "taken as world -> camera: expected are poses camera -> world", own()),
    (pose_of(lambda T: T * FLIP), "as camera -> world of OpenGL's axes: expected", own()),
    (own(depth=lambda frame: 1 / frame.depth), r"/ depth: expected are .* depths along z", own()),
    (
        own(depth=lambda frame: frame.depth * (0.5 + frame.index % 2)),
        r"a scale, .* of their own in each: align them .* prior.max_misfit=([\d.]+) maps them as they are",
        *(own(), {"max_misfit": "{1}"}),
    ),
    (
        own(confidence=lambda frame: np.full(frame.depth.shape, 0.3)),
        r"such as probabilities, give 1 \+ confidence",
        own(confidence=lambda frame: 1 + np.full(frame.depth.shape, 0.3)),
    ),
    (
        own(confidence=lambda frame: np.full(frame.depth.shape, np.inf)),
        "is inf: give finite numbers",
        own(confidence=lambda frame: np.full(frame.depth.shape, 9.0)),
    ),
    (own(confidence=lambda frame: np.ones((4, 5))), r"confidence must be numbers \(48, 64\), as what it is of", own()),
    (own(intrinsics=lambda frame: [999, 999, 320, 240]), r"give those of the file's own size \(64x48\)", own()),
    (
        own(intrinsics=lambda frame: matrix(frame).T),
        "must be fx 0 cx, 0 fy cy, 0 0 1, row by row, .*: transpose it",
        own(intrinsics=matrix),
    ),
    (own(intrinsics=lambda frame: [1, 2, 3]), r"must be \[fx, fy, cx, cy\] or a camera matrix", own()),
    (own(depth=lambda frame: frame.depth * np.nan), "none of its 6 files has a depth above 0", own()),
    (
        gone("own/IMG_9.npz"),
        "predict it, write one whose T_world_camera is nan, or leave the frame out .dataset.start, stop, stride",
        fetched("own/IMG_9.npz"),
        lambda root, said: np.savez(
            root / "own/IMG_9.npz", depth=truth()[1].depth, T_world_camera=np.full((4, 4), np.nan)
        ),
        {"names": [NAMES[0]] + NAMES[2:]},
    ),
    (
        {"names": ["a", "b", "c"]},
        "name the files as the images, or choose the frames that were predicted",
        *({"names": NAMES[:3]}, {"names": NAMES}),
    ),
    (put("own/IMG_9.npz", b"PK"), "IMG_9.npz: .*; it has nothing", own()),
    ((own(".npy"), listed_poses(), put("own/IMG_9.npy", b"x")), "no .npy that can be read .*: write it again", own()),
    (
        own(".npy"),
        "neither of poses.txt, poses.json: prior=files needs poses beside depths",
        *(listed_poses(), named_poses()),
    ),
    (
        (own(".npy"), listed_poses(5)),
        "must have one for each, in the order of their names; or give poses.json, which has them by name",
        *(listed_poses(), (gone("own/poses.txt"), named_poses())),
    ),
    (
        (own(".npy"), listed_poses(), lines("own/poses.txt", lambda words: [f"{9 - float(words[0])}", *words[1:]])),
        r"not in order of time, .*: write the lines in the order IMG_8, IMG_9, IMG_10, …, or give poses.json",
        *(listed_poses(), (gone("own/poses.txt"), named_poses())),
    ),
    ((own(".npy"), named_poses(1)), "lacks T_world_camera of 5 of 6 files", named_poses()),
    ((own(".npy"), put("own/poses.json", "[]")), 'must hold {"T_world_camera": {"name of the file', named_poses()),
    ({"scale": "relative"}, "must be one of auto, (metric), arbitrary", {"scale": "{1}"}),
    ({"scale": "arbitrary", "median_depth": 0.0}, "must be above 0 m", {"median_depth": 2.0}),
    ({"depth_scale": 0.0}, "must be raw units per metre .(5000) for TUM", {"depth_scale": "{1}"}),
]


def read_own(root: Path, names: list[str] = NAMES, folder: str | None = None, **keys) -> int:
    """The answers of `prior=files` to all windows of frames that have these names."""
    found, frames = Named(names=names), dict(zip(NAMES, truth(), strict=True))
    prior = Files(folder or root / "own", **KEYS | keys)
    prior.check(found, tiny_run.WINDOW_SIZE)
    known = [frames.get(name, truth()[0]) for name in names]
    calls = windows(len(found), tiny_run.WINDOW_SIZE)
    return len([prior.predict(call, [known[i] for i in call.views], found.intrinsics) for call in calls])


CALIBRATIONS = {
    "cameras.txt": f"1 PINHOLE 640 480 500.5 502.25 {CORNER}\n",
    "transforms.json": json.dumps(TRANSFORMS),
    "info.yaml": ROS,
    "orb.yaml": ORB,
    "camchain.yaml": KALIBR,
    "intrinsics.yaml": MAST3R,
    "vipe.json": json.dumps(OF_VIPE),
}
OTHER_MODEL = "1 {} 640 480 500 500 320 240 0 0 0 0 0 0 0 0\n"
LENS_OF_ROS = "[0.1, -0.2, 1e-3, -0.002, 0.05]"
FOREIGN = [
    *(
        ("cameras.txt", OTHER_MODEL.format(model), f"the camera model {model} is not read.*image_undistorter")
        for model in ("EQUIRECTANGULAR", "FISHEYE624")
    ),
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
    ("transforms.json", json.dumps(TRANSFORMS | {"camera_model": "FISHEYE624"}), "FISHEYE624 is not read"),
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
    ("info.yaml", ROS.split("distortion_model")[0], "has no distortion_coefficients: add"),
    ("info.yaml", "a: [1", "damaged or no yaml"),
    ("info.yaml", "!!python/object/apply:os.getcwd []", "damaged or no yaml"),
    ("orb.yaml", ORB.replace("PinHole", "KannalaBrandt8"), "OPENCV_FISHEYE with p1, p2 is not read"),
    ("orb.yaml", ORB.replace("Camera.width: 640\n", ""), "has no Camera.width: add"),
    ("orb.yaml", ORB + "Camera2.fx: 3\n", "more than one camera"),
    ("orb.yaml", ORB + "Camera.model: equirectangular\n", "equirectangular is not read"),
    ("camchain.yaml", KALIBR + KALIBR.replace("cam0:", "cam1:").replace("500.5", "501"), "2 different cameras"),
    ("camchain.yaml", KALIBR.replace("pinhole", "omni"), "the camera model omni is not read, only pinhole"),
    ("camchain.yaml", KALIBR.replace("resolution", "size"), "has no resolution: add"),
    ("camchain.yaml", KALIBR.replace("[640, 480]", "[640]"), "resolution width, height: correct them"),
    ("intrinsics.yaml", MAST3R.replace("width", "widht"), "unknown keys: widht"),
    ("intrinsics.yaml", MAST3R.split("calib")[0] + "calibration: [1, 2, 3]\n", "must be fx, fy, cx, cy.*got 3"),
    ("intrinsics.yaml", MAST3R.split("calib")[0] + "calibration: pinhole\n", r"must have data: \[numbers\]"),
    ("vipe.json", json.dumps(OF_VIPE | {"fx": None}), "fx must be a finite number"),
    ("vipe.json", json.dumps(OF_VIPE | {"k6": 0.1}), "unknown keys: k6"),
]
OF_CALIBRATIONS = [
    ((put(name, text), {"file": name}), f"(?s){name}.*{message}", put(name, CALIBRATIONS[name]))
    for name, text, message in FOREIGN
]
OVO = "class_names_reduced: [wall, chair]\nmap_to_reduced: {93: 0, 20: 1}\n"
OF_CLASSES = [
    (
        (put("a.txt", ""), {"file": "a.txt"}),
        "names no class: give a name a line, `id name` a line, or YAML with class_names_reduced and map_to_reduced",
        *(put("a.txt", "wall\nchair\n"), put("a.txt", "4 wall\n7 chair\n"), (put("b.yaml", OVO), {"file": "b.yaml"})),
    ),
    *(
        ((put("a.txt", text), {"file": "a.txt"}), f"{message}.*: give a name a line", put("a.txt", right))
        for text, message, right in (
            ("wall\nwall\n", "a.txt names 'wall' twice", "wall\n"),
            ("1 wall\n1 chair\n", "an id stands in it twice", "1 wall\n2 chair\n"),
            (
                "1 wall\n2 floor\nceiling\n",
                "'ceiling' is not: give each an id, or none",
                "1 wall\n2 floor\n3 ceiling\n",
            ),
            ("1 wall\n2 floor\nceiling\n", "'ceiling' is not: give each an id, or none", "wall\nfloor\nceiling\n"),
            (b"\xff\xfe\x00", "a.txt cannot be read", "wall\n"),
        )
    ),
    *(
        ((put("a.yaml", text), {"file": "a.yaml"}), f"{message}.*: give a name a line", put("a.yaml", OVO))
        for text, message in (
            ("[wall]", "a.yaml is no class file .it is no mapping"),
            ("class_names_reduced: [wall]", "it lacks map_to_reduced"),
            ("class_names_reduced: [wall]\nmap_to_reduced: {1: 2}", "says 1: 2, and there are 1 classes"),
            ("class_names_reduced: wall\nmap_to_reduced: {}", "expected a list, got str"),
            ("class_names_reduced: [3]\nmap_to_reduced: {}", "3 is no name"),
            ("a: [", "a.yaml is no class file"),
        )
    ),
    ({"file": "a.txt"}, "class file .*a.txt does not exist: give a name a line", put("a.txt", "wall\n")),
]
PATH, PLY, OUT = "path.txt", "cloud.ply", "out"


def write_peer(root: Path) -> None:
    """Another system's path and cloud of the tiny room."""
    write_system(root, *room())


def path_with(change: Callable[[np.ndarray, np.ndarray], tuple]) -> Step:
    return lambda root, said: save_trajectory_tum(root / PATH, *change(*room()[:2]))


def read_score(root: Path, **keys) -> float:
    words = [f"trajectory={root / PATH}", f"points={root / PLY}", "method=peer", f"out={root / OUT}"]
    return score(tiny_run.compose(*words, *(f"{key}={value}" for key, value in keys.items()), name="score"))[0]


def cloud_of(points: np.ndarray) -> Step:
    return lambda root, said: save_points_ply(root / PLY, points, 0 * points, 0 * points)


SPREAD = np.random.default_rng(0).normal(size=(99, 3))
FAR = np.concatenate([SPREAD, [[1e9, 0, 0]]])
TEXT_PLY = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
CORNERS = "0 0 0\n1 0 0\n0 1 0\n"
SE3 = {"evaluation.alignment": "se3"}
OF_SCORE = [
    (
        path_with(lambda times, poses: (2 * times, poses)),
        r"3 of 6 poses.*: write the data set's timestamps .* or accept fewer \(min_associated_percent\)",
        *(fetched(PATH), {"min_associated_percent": 50}),
    ),
    (
        path_with(lambda times, poses: (times + 0.05, poses)),
        "no pose is within .*, choose the same frames .*, raise max_time_difference",
        {"max_time_difference": 0.06},
    ),
    (
        (path_with(lambda times, poses: (times[3:], poses[3:])), {"dataset.stop": 3}),
        r"choose the same frames \(dataset.start, stop, stride\)",
        {"dataset.stop": 6},
    ),
    (
        path_with(lambda times, poses: (times, np.linalg.inv(poses))),
        "where the poses are taken as world -> camera: expected are",
        fetched(PATH),
    ),
    (
        path_with(lambda times, poses: ([*times, *times], [*poses, *SIMILARITY.apply_to_poses(poses)])),
        "keep one path, with all digits of its times",
        *(fetched(PATH), path_with(lambda times, poses: ([*times, *times + 0.001], [*poses, *poses]))),
    ),
    (gone(PATH), "path.txt is no file: give a file with `timestamp tx ty tz qx qy qz qw`", fetched(PATH)),
    (put(PATH, "1 2 3\n"), "path.txt:1: expected `timestamp tx ty tz qx qy qz qw`", fetched(PATH)),
    (gone(PLY), "cloud.ply is no file: give a PLY file", fetched(PLY)),
    (put(PLY, "# nothing\n"), "cloud.ply is no PLY file .*: give a PLY file", fetched(PLY)),
    (cloud_of(SPREAD[:0]), "cloud.ply has no points: write the points of the map as PLY", cloud_of(SPREAD)),
    (cloud_of(FAR), "give the points in metres, and without stray ones", cloud_of(SPREAD)),
    (
        put(PLY, f"{TEXT_PLY}{CORNERS}nan 0 0\n"),
        "1 of 4 points are not finite .*: leave them out of the file",
        put(PLY, f"{TEXT_PLY.replace('4', '3', 1)}{CORNERS}"),
    ),
    (
        (lambda root, said: read_score(root), SE3),
        r"method=NAME of emgs score\), choose another out=FOLDER or move the folder away",
        *({"method": "other"}, {"out": "{root}/elsewhere"}, moved(OUT, "away")),
    ),
    ({"method": "a/b"}, "must be a name that is one folder below .*: choose another", {"method": "ab"}),
    ({"min_matched_percent": "many"}, "a number from 0 to (100).*: give such a value", {"min_matched_percent": "{1}"}),
]


def read_plan(root: Path, *words: str, **keys) -> int:
    """Jobs of an evaluation of which one has a result, of other settings where the words say so."""
    given = [f"out={root / OUT}", *words, *(f"{key}={value}" for key, value in keys.items())]
    settings = OmegaConf.to_container(compose("suite=smoke", *given, name="evaluate"), resolve=True)
    return len([is_finished(job.folder, OmegaConf.to_container(job.config, resolve=True)) for job in plan(settings)])


def write_finished(root: Path) -> None:
    settings = OmegaConf.to_container(compose("suite=smoke", f"out={root / OUT}", name="evaluate"), resolve=True)
    for job in plan(settings):
        config = OmegaConf.to_container(job.config, resolve=True)
        content = {"provenance": {"format": RESULT_FORMAT, "config": jsonable(config)}}
        put(str((job.folder / METRICS_FILE).relative_to(root)), json.dumps(content))(root, None)


OTHER = {"overrides": "'[slam.em.noise=0.3]'"}
OF_EVALUATION = [
    (
        OTHER,
        r"\(\+variants.NAME=\{KEY:VALUE\} of emgs evaluate, .*, choose another out=FOLDER or move the folder away",
        {"overrides": "'[]'", "+variants.other": "'{{slam.em.noise:0.3}}'"},
        *({"out": "{root}/elsewhere"}, moved(OUT, "away")),
    ),
    ({"overrides": "'[prior.seed=3]'"}, r"give (seeds)=\[…\]", {"overrides": "'[]'", "seeds": "'[3]'"}),
    ({"overrides": "'[dataset=tum]'"}, "give suite=NAME", {"overrides": "'[]'", "suite": "smoke"}),
    (
        {"overrides": "'[prior=multiview_stereo]'", "seeds": "'[0,1]'"},
        r"give one seed, seeds=(\[0\])",
        {"seeds": "'{1}'", "out": "{root}/elsewhere"},
    ),
]


def written_with_points(root: Path) -> None:
    save_points_ply(written_run(root / "run") / "points.ply", SPREAD, SPREAD, np.clip(np.abs(SPREAD), 0, 1))


def read_export(root: Path, **keys) -> list[Path]:
    given = {"formats": "[frustums]"} | keys
    return export_run(
        compose(f"folder={root / 'run'}", *(f"{key}={value}" for key, value in given.items()), name="export")
    )


FRUSTUMS = {"formats": "'[frustums]'"}
OF_EXPORT = [
    ({"formats": "'[obj]'"}, "formats=obj is not known: choose of (colmap), nerfstudio", {"formats": "'[{1}]'"}),
    ({"formats": "'[]'"}, "writes nothing: give (colmap), nerfstudio or frustums", {"formats": "'[{1}]'"}),
    (
        (put("run/colmap/x", ""), {"formats": "'[colmap]'"}),
        "colmap is there already: remove it, or write elsewhere with out=FOLDER",
        *({"out": "{root}/there"}, (gone("run/colmap/x"), lambda root, said: (root / "run/colmap").rmdir())),
    ),
    ({"scale": 2, "length": "'[0,1,2]'"}, "both say how long things are: give one of them", {"scale": "'null'"}),
    ({"length": "'[0,1]'"}, r"length must be \[frame,frame,metres\]", {"length": "'[0,1,2]'"}),
    ({"length": "'[0,0,1]'"}, "at one place: take two that are far apart", {"length": "'[0,5,1]'"}),
    ({"length": "'[0,3,1]'"}, r"frame 3 .*: take another one \(index in frames.jsonl\)", {"length": "'[0,4,1]'"}),
    (
        (gone("run/points.ply"), {"formats": "'[colmap]'"}),
        "lacks points.ply, which formats=colmap needs: run again",
        *(fetched("run/points.ply"), FRUSTUMS),
    ),
    (
        (edit("run/metrics.json", ('"fingerprint": "', '"fingerprint": "0')), {"formats": "'[colmap]'"}),
        r"not those that were mapped. formats=(\[frustums\]) needs no images",
        {"formats": "'{1}'"},
    ),
    ({"images": "large", "formats": "'[colmap]'"}, "images must be one of (used), original", {"images": "{1}"}),
    (
        gone("run/metrics.json"),
        "holds no finished run: it lacks metrics.json; run it to its end",
        fetched("run/metrics.json"),
    ),
]


def read_answer(root: Path, words: str | None = "sofa", **keys) -> dict:
    given = {"map": root / "run", "text": words} | keys
    return query(
        compose(*(f"{key}={'null' if value is None else value}" for key, value in given.items()), name="query")
    )


LINE_OF_POSE = "1 0 0 0 0 0 0 1\n"
OF_QUERY = [
    (
        {"words": None},
        "nothing is asked: give text=chair, text=.chair,table. or classes=FILE",
        *({"words": "sofa"}, {"words": "'[sofa,wall]'"}, (put("c.txt", "sofa\n"), {"classes": "{root}/c.txt"})),
    ),
    ({"words": "soaf"}, r"the nearest are (\w+)\.", {"words": "{1}"}),
    ({"words": "xyz"}, r"there are wall, (\w+)\.", {"words": "{1}"}),
    ({"words": "'[sofa,sofa]'"}, "none empty and each once", {"words": "'[sofa,wall]'"}),
    ({"against": "sofa"}, "asked for too: leave it out of one", {"against": "wall"}),
    (
        (put("p.txt", LINE_OF_POSE), {"frame": 1, "pose": "{root}/p.txt"}),
        "both say from where to draw: give one of them",
        *({"frame": None}, {"pose": None}),
    ),
    ({"frame": 77}, r"no pose of frame=77: choose one from (\d) to \d", {"frame": "{1}"}),
    ({"pose": "{root}/p.txt"}, "is no file: give lines `timestamp tx ty tz qx qy qz qw`", put("p.txt", LINE_OF_POSE)),
    ((put("p.txt", "# \n"), {"pose": "{root}/p.txt"}), "has no pose: give lines", put("p.txt", LINE_OF_POSE)),
    ({"map": "{root}/nowhere"}, "is no folder: give the one that a run wrote", {"map": "{root}/run"}),
]
OF_CONFIG = [
    ({"words": ["slam.em=papre"]}, r"with (slam/em=default)$", {"words": "['{1}']"}),
    ({"words": ["em.num_neighbours=4"]}, r"near names: (slam\.em\.num_neighbours)", {"words": "['{1}=4']"}),
    (
        {"words": ["graph=default", "graph.location.patience=2"]},
        r"is called (\S+) now",
        {"words": "[graph=default, '{1}=2']"},
    ),
    ({"words": ["dataset=scannetpp"]}, r"there are apartment, bonn, (colmap)", {"words": "['dataset={1}']"}),
    (
        {"words": ["prior=simulated", "prior/dense=itermvs"]},
        r"is a choice of (prior=\w+) only",
        {"words": "['{1}', prior/dense=itermvs]"},
    ),
]


def read_sweep(root: Path, words: list[str]) -> list:
    config = compose(*words, name="sweep")
    return variants(config, read_axes(config))


def read_search(root: Path, words: list[str]) -> tuple:
    config = compose(*words, name="tune")
    return read_space(config), read_objectives(config)


OF_SWEEP = [
    (
        {"words": []},
        r"choose one with (sweep=gates) or '(axes=\S+)'$",
        *({"words": "['{1}']"}, {"words": '["{2}"]'}),
    ),
    ({"words": ["axes={em.noise:[0]}"]}, r"near names: (slam\.em\.noise)", {"words": '["axes={{{1}:[0]}}"]'}),
    ({"words": ["axes={slam.em.noise:2}"]}, r"write (\S+): \[(\d), …\]", {"words": '["axes={{{1}:[{2},3]}}"]'}),
    (
        {"words": ["axes={slam.em.noise:[0]}", "grid=all"]},
        "grid must be one of product, (one_at_a_time)",
        {"words": '["axes={{slam.em.noise:[0]}}", "grid={1}"]'},
    ),
    (
        {"words": ["axes={slam.em.noise:[-9]}"]},
        r"from (\d) to \S+, got -9",
        {"words": '["axes={{slam.em.noise:[{1}]}}"]'},
    ),
]


def space(key: str, given: str) -> dict[str, str]:
    return {"words": f'["space={{{{{key}:{given}}}}}"]'}


OF_SEARCH = [
    ({"words": []}, r"with (tune=gates), or '(space=\S+)'$", {"words": "['{1}']"}, {"words": '["{2}"]'}),
    (space("em.noise", "[0,1]"), r"near names: (slam\.em\.noise)", space("{1}", "[0,1]")),
    (space("slam.em.noise", "[1]"), "two or more different numbers", space("slam.em.noise", "[1,2]")),
    (space("slam.em.noise", "3"), "must be a range {low: …, high: …", space("slam.em.noise", "{{low:0.1,high:1}}")),
    (
        space("slam.em.noise", "{{low:1,high:0.1}}"),
        "needs low < high, and low above 0 with log: true",
        space("slam.em.noise", "{{low:0.1,high:1,log:true}}"),
    ),
    (
        {"words": ["tune=gates", "objectives=[best]"]},
        r"must be minimize METRIC or maximize METRIC",
        {"words": '["tune=gates", "objectives=[minimize trajectory/ate_sim3_m]"]'},
    ),
]
TABLES = {
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
    "calibration": (lambda root: None, lambda root, file: read_calibration(root / file), OF_CALIBRATIONS),
    "classes": (lambda root: None, lambda root, file: read_classes(root / file), OF_CLASSES),
    "score": (write_peer, read_score, OF_SCORE),
    "evaluate": (write_finished, read_plan, OF_EVALUATION),
    "export": (written_with_points, read_export, OF_EXPORT),
    "query": (written_with_points, read_answer, OF_QUERY),
    "sweep": (lambda root: None, read_sweep, OF_SWEEP),
    "tune": (lambda root: None, read_search, OF_SEARCH),
    "config": (lambda root: None, lambda root, words: compose(*words), OF_CONFIG),
}
CASES = [(name, *row[:2], remedy) for name, (_, _, rows) in TABLES.items() for row in rows for remedy in row[2:]]


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """The folder of what is written in a layout, once."""

    @cache
    def written(name: str) -> Path:
        folder = tmp_path_factory.mktemp(name)
        TABLES[name][0](folder)
        return folder

    return written


@pytest.mark.parametrize(("name", "cause", "message", "remedy"), CASES, ids=[f"{c[0]}: {c[2][:40]}" for c in CASES])
def test_what_a_message_advises_helps(name, cause, message, remedy, sound, tmp_path):
    root, read = tmp_path / "copy", TABLES[name][1]
    shutil.copytree(sound(name), root)
    (tmp_path / "sound").symlink_to(sound(name))
    options = done(cause, root)
    with pytest.raises((ValueError, OSError)) as caught:
        read(root, **options)
    said = re.search(message, str(caught.value))
    assert said is not None, caught.value
    assert read(root, **options | done(remedy, root, said))

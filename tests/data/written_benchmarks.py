"""Sequences of EuRoC and KITTI, projects of COLMAP and folders of nerfstudio with three images of the known scene."""

import json
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from tests.data.written_scene import color_image, scene_pose

START, STEP = 1403636579763555584, 50_000_000  # of EuRoC's first image and to the next, nanoseconds
EUROC_SIZE, KITTI_SIZE = (160, 120), (160, 48)
LENS = [130.0, 128.0, 80.5, 59.0, -0.02, 0.004, 0.001, -0.002]
T_BODY_CAMERA = np.eye(4)
T_BODY_CAMERA[:3, :3] = Rotation.from_euler("xyz", [80, -10, 95], degrees=True).as_matrix()
T_BODY_CAMERA[:3, 3] = -0.02, -0.065, 0.01
SENSOR = f"""# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS:
  cols: 4
  rows: 4
  data: {T_BODY_CAMERA.ravel().tolist()}
rate_hz: 20
resolution: [160, 120]
camera_model: pinhole
intrinsics: {LENS[:4]} #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: {LENS[4:]}
"""
K = np.array([[92.0, 0, 78.0], [0, 92.0, 23.0], [0, 0, 1]])
CENTER = np.array([0.06, -0.001, 0.004])  # of KITTI's camera 2 in the axes of camera 0, metres

NAMES = ("img10.png", "img2.png", "img33.png")  # in the order of the files, which is not that of the numbers
CAMERAS = {  # the same as dataset.intrinsics, whose pixels are counted from the centre of the first
    "PINHOLE": ("130 128 81 59.5", [130, 128, 80.5, 59]),
    "SIMPLE_PINHOLE": ("130 81 59.5", [130, 130, 80.5, 59]),
    "SIMPLE_RADIAL": ("130 81 59.5 .02", [130, 130, 80.5, 59, 0.02, 0, 0, 0]),
    "RADIAL": ("130 81 59.5 .02 -.004", [130, 130, 80.5, 59, 0.02, -0.004, 0, 0]),
    "OPENCV": ("130 128 81 59.5 .02 -.004 .001 -.002", [130, 128, 80.5, 59, 0.02, -0.004, 0.001, -0.002]),
    "FOV": ("130 128 81 59.5 .7", ["FOV", 130, 128, 80.5, 59, 0.7]),
    "RADIAL_FISHEYE": ("130 81 59.5 .02 -.004", ["OPENCV_FISHEYE", 130, 130, 80.5, 59, 0.02, -0.004, 0, 0]),
}


def write_euroc(root: Path) -> None:
    """MH_01_easy with grey images; the truth begins with the second image, 1 ms before it."""
    folder = root / "MH_01_easy" / "mav0"
    (folder / "cam0" / "data").mkdir(parents=True)
    (folder / "state_groundtruth_estimate0").mkdir()
    listed, states = "#timestamp [ns],filename\r\n", "#timestamp, p_RS_R_x [m], …\n"
    for i in range(3):
        time = START + i * STEP
        grey = cv2.cvtColor(color_image(i, EUROC_SIZE), cv2.COLOR_BGR2GRAY)
        cv2.imwrite(str(folder / "cam0" / "data" / f"{time}.png"), grey)
        listed += f"{time},{time}.png\r\n"
        body = scene_pose(i) @ np.linalg.inv(T_BODY_CAMERA)
        x, y, z, w = Rotation.from_matrix(body[:3, :3]).as_quat()
        if i:
            row = [*body[:3, 3], w, x, y, z, *np.arange(9) / 7]
            states += f"{time - 1_000_000}," + ",".join(f"{value:.9f}" for value in row) + "\n"
    (folder / "cam0" / "data.csv").write_text(listed)
    (folder / "cam0" / "sensor.yaml").write_text(SENSOR)
    (folder / "state_groundtruth_estimate0" / "data.csv").write_text(states, encoding="utf-8")


def write_kitti(root: Path) -> None:
    """Sequence 07 with the images of camera 2; poses are those of camera 0."""
    folder = root / "sequences" / "07"
    (folder / "image_2").mkdir(parents=True)
    (root / "poses").mkdir()
    for i in range(3):
        cv2.imwrite(str(folder / "image_2" / f"{i:06d}.png"), color_image(i, KITTI_SIZE))
    lines = [
        f"P{camera}: " + " ".join(f"{v:.12e}" for v in np.column_stack([K, -K @ (CENTER * (camera == 2))]).ravel())
        for camera in range(4)
    ]
    (folder / "calib.txt").write_text("\n".join([*lines, "Tr: " + "0 " * 12, ""]))
    (folder / "times.txt").write_text("0.000000e+00\n1.037e-01\n2.074e-01\n")
    np.savetxt(root / "poses" / "07.txt", [scene_pose(i)[:3].ravel() for i in range(3)])


def write_named(folder) -> None:
    folder.mkdir(parents=True)
    for i, name in enumerate(NAMES):
        cv2.imwrite(str(folder / name), color_image(i, EUROC_SIZE))


def write_colmap(folder, camera: str = "PINHOLE", second: str = ""):
    """Two lines an image; the second may list points. Returns the folder of the model."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    write_named(folder / "images")
    (model / "cameras.txt").write_text(f"# cameras\n7 {camera} 160 120 {CAMERAS[camera][0]}\n")
    lines = ["# images"]
    for i, name in enumerate(NAMES):
        pose = np.linalg.inv(scene_pose(i))
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        lines += [f"{i + 3} {w} {x} {y} {z} {pose[0, 3]} {pose[1, 3]} {pose[2, 3]} 7 {name}", second]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "points3D.txt").write_text("1 0 0 1 255 0 0 -1\n")
    return model


def write_nerfstudio(folder, **changes) -> None:
    write_named(folder / "images")
    frames = []
    for i, name in enumerate(NAMES):
        pose = scene_pose(i)  # to OpenGL's axes: y up, z back
        turned = np.column_stack([pose[:, 0], -pose[:, 1], -pose[:, 2], pose[:, 3]])
        frames.append({"file_path": f"images/{name}", "transform_matrix": turned.tolist()})
    values = {"fl_x": 130, "fl_y": 128, "cx": 81, "cy": 59.5, "w": 160, "h": 120, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(values | changes))

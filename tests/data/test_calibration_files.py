"""Calibration files of other programs, written as those programs write them."""

import json

import cv2
import numpy as np
import pytest

from emgs_jax.data.calibration_files import read_calibration

K = (500.5, 502.25, 319.0, 241.5)  # pixel centres at integers, as OpenCV
LENS = (0.1, -0.2, 0.001, -0.002, 0.05)
CORNER = f"{K[2] + 0.5} {K[3] + 0.5}"  # COLMAP's and nerfstudio's 0, 0 is the corner of the image
TRANSFORMS = {
    "fl_x": K[0],
    "fl_y": K[1],
    "cx": K[2] + 0.5,
    "cy": K[3] + 0.5,
    "w": 640,
    "h": 480,
    "camera_model": "OPENCV",
    "frames": [{"file_path": "images/1.png", "transform_matrix": np.eye(4).tolist()}],
}
ROS = """image_width: 640
image_height: 480
camera_name: narrow
camera_matrix:
  rows: 3
  cols: 3
  data: [500.5, 0, 319.0, 0, 502.25, 241.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, -0.2, 1e-3, -0.002, 0.05]
"""
ORB = "%YAML:1.0\nCamera.type: PinHole\n" + "".join(
    f"Camera.{key}: {value}\n"
    for key, value in zip(
        ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "width", "height"), (*K, *LENS, 640, 480), strict=True
    )
)
PLAIN = dict(zip(("fx", "fy", "cx", "cy"), K, strict=True)) | {"width": 640, "height": 480}
FISHEYE = LENS[:4]
KALIBR = f"""cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: {[*FISHEYE]}
  distortion_model: equidistant
  intrinsics: {[*K]}
  resolution: [640, 480]
  rostopic: /cam0/image_raw
"""
RATIONAL = (*LENS, 0.01, -0.02, 0.003)
MAST3R = f"width: 640\nheight: 480\n# a comment\ncalibration: {[*K, *LENS]}\n"
FILES = {
    "cameras.txt": (f"# Camera list\n1 PINHOLE 640 480 500.5 502.25 {CORNER}\n", ()),
    "opencv/cameras.txt": (f"1 OPENCV 640 480 500.5 502.25 {CORNER} .1 -.2 .001 -.002\n", LENS[:4]),
    "transforms.json": (json.dumps(TRANSFORMS), ()),
    "lens/transforms.json": (
        json.dumps(TRANSFORMS | dict(zip(("k1", "k2", "p1", "p2"), LENS, strict=False))),
        LENS[:4],
    ),
    "camera_info.yaml": (ROS, LENS),
    "orb.yaml": (ORB, LENS),
    "orb_rgbd.yaml": (ORB + "ThDepth: 40.0\nDepthMapFactor: 5000.0\n", LENS),  # of ORB-SLAM2
    "openvslam.yaml": (
        ORB.replace("Camera.width", "Camera.cols").replace("Camera.height", "Camera.rows")
        + "Camera.setup: monocular\nCamera.model: perspective\nFeature.max_num_keypoints: 2000\n",
        LENS,
    ),
    "intrinsics.yaml": (MAST3R, LENS),
    "straight/intrinsics.yaml": (f"width: 640\nheight: 480\ncalibration: {[*K]}\n", ()),
    "vipe.json": (json.dumps(PLAIN), ()),
    "rational.yaml": (
        ROS.replace("plumb_bob", "rational_polynomial").replace("0.05]", "0.05, 0.01, -0.02, .003]"),
        RATIONAL,
    ),
    "full/cameras.txt": (f"1 FULL_OPENCV 640 480 500.5 502.25 {CORNER} {' '.join(map(str, RATIONAL))}\n", RATIONAL),
}
OF_FISHEYES = {
    "cameras.txt": f"1 OPENCV_FISHEYE 640 480 500.5 502.25 {CORNER} .1 -.2 .001 -.002\n",
    "transforms.json": json.dumps(
        TRANSFORMS | dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True)) | {"camera_model": "OPENCV_FISHEYE"}
    ),
    "ngp/transforms.json": json.dumps(
        TRANSFORMS | dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True)) | {"is_fisheye": True, "p1": 0}
    ),
    "camera_info.yaml": ROS.replace("plumb_bob", "equidistant").replace(", 0.05]", "]"),
    "opencv.yaml": ROS.replace("distortion_model: plumb_bob", "fisheye_model: 1").replace(", 0.05]", "]"),
    "orb.yaml": ORB.replace("PinHole", "KannalaBrandt8").replace("k3", "k9").replace("p1", "k3").replace("p2", "k4"),
    "openvslam.yaml": ORB.replace("type: PinHole", "model: fisheye")
    .replace("k3", "k9")
    .replace("p1", "k3")
    .replace("p2", "k4"),
    "camchain.yaml": KALIBR,
    "stereo/camchain.yaml": KALIBR + KALIBR.replace("cam0:", "cam1:"),  # twice the same
    "sensor.yaml": KALIBR.replace("cam0:", "sensor_type: camera")
    .replace("\n  ", "\n")
    .replace("coeffs", "coefficients"),
}


def write(folder, name, text):
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", FILES)
def test_every_format_names_the_same_camera(name, tmp_path):
    text, lens = FILES[name]
    camera = read_calibration(write(tmp_path, name, text))
    np.testing.assert_allclose(camera.intrinsics, K, rtol=1e-12)
    assert camera.size == (640, 480)
    np.testing.assert_allclose(camera.distortion, lens, rtol=1e-12)


@pytest.mark.parametrize("name", OF_FISHEYES)
def test_every_format_names_the_same_fisheye(name, tmp_path):
    camera = read_calibration(write(tmp_path, name, OF_FISHEYES[name]))
    assert camera.model == "OPENCV_FISHEYE" and camera.size == (640, 480)
    np.testing.assert_allclose((*camera.intrinsics, *camera.distortion), (*K, *FISHEYE), rtol=1e-12)


@pytest.mark.parametrize("shape", [(1, 5), (5, 1), (1, 4), (1, 14)])
def test_what_opencv_writes_is_read(shape, tmp_path):
    lens, matrix = np.zeros(shape), np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]])
    lens.flat[:5] = LENS if lens.size > 4 else LENS[:4]
    path = tmp_path / "calibration.yml"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in (("image_width", 640), ("image_height", 480), ("camera_matrix", matrix)):
        file.write(key, value)
    file.write("distortion_coefficients", lens)
    file.release()
    camera = read_calibration(path)
    assert (camera.intrinsics, camera.size, camera.distortion) == (K, (640, 480), LENS[: min(lens.size, 5)])

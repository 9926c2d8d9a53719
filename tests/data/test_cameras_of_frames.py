"""Images with a camera each; oracle: all show one wall, which a common camera sees in the same pixels."""

import json

import cv2
import numpy as np
import pytest

from emgs_jax.data import intrinsics
from emgs_jax.data.posed_images import Colmap, Nerfstudio
from emgs_jax.data.readable import ReadableFrames

SIZE, COUNT = (160, 120), 7
FOCAL = [130.0 * (1 + 0.02 * np.sin(row)) for row in range(COUNT)]
CENTER = [(79.5 + 2 * np.cos(row), 59.5 - row / 3) for row in range(COUNT)]


def wall(focal, center, bend=0.0):
    """Grey image of a pattern at infinity, as a camera with the distortion k1 = `bend` sees it."""
    u, v = np.meshgrid(*(np.arange(side, dtype=float) for side in SIZE))
    rays = np.stack([(u - center[0]) / focal, (v - center[1]) / focal], axis=-1)
    if bend:
        camera = np.float64([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]])
        pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
        rays = cv2.undistortPoints(pixels, camera, np.float64([bend, 0, 0, 0]), criteria=(3, 50, 1e-9))
        rays = rays.reshape(SIZE[1], SIZE[0], 2)
    return np.uint8(np.round(128 + 60 * np.sin(20 * rays[..., 0]) + 60 * np.cos(23 * rays[..., 1])))


def write(root, bend):
    (root / "images").mkdir(parents=True)
    for row in range(COUNT):
        cv2.imwrite(str(root / f"images/{row}.png"), wall(FOCAL[row], CENTER[row], bend))


def nerfstudio(root, bend):
    write(root, bend)
    frames = []
    for row, (focal, (cx, cy)) in enumerate(zip(FOCAL, CENTER, strict=True)):
        own = {"fl_x": focal, "fl_y": focal, "cx": cx + 0.5, "cy": cy + 0.5, "w": SIZE[0], "h": SIZE[1], "k1": bend}
        frames.append({"file_path": f"images/{row}.png", "transform_matrix": np.eye(4).tolist()} | own)
    (root / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}))
    return Nerfstudio


def colmap(root, bend):
    write(root, bend)
    (root / "sparse/0").mkdir(parents=True)
    cameras, images = [], []
    for row, (focal, (cx, cy)) in enumerate(zip(FOCAL, CENTER, strict=True)):
        cameras.append(f"{row} OPENCV {SIZE[0]} {SIZE[1]} {focal} {focal} {cx + 0.5} {cy + 0.5} {bend} 0 0 0")
        images += [f"{row + 1} 1 0 0 0 0 0 0 {row} {row}.png", ""]
    (root / "sparse/0/cameras.txt").write_text("\n".join(cameras))
    (root / "sparse/0/images.txt").write_text("\n".join(images))
    return Colmap


@pytest.mark.parametrize("bend", [0.0, -0.15])
@pytest.mark.parametrize("make", [nerfstudio, colmap])
def test_images_of_a_camera_that_focuses_are_brought_to_one(tmp_path, make, bend):
    frames = ReadableFrames(make(tmp_path, bend)(str(tmp_path), size=SIZE, start=1))
    fx, _, cx, cy = frames.intrinsics
    expected = wall(fx, (cx, cy))
    for frame in frames:
        inside = np.abs(frame.image[8:-8, 8:-8, 0].astype(int) - expected[8:-8, 8:-8])
        assert np.percentile(inside, 99) <= 4  # without it, up to 60
    assert "are of 6 different cameras (focal lengths of 127." in frames.calibration["note"]
    assert frames.fingerprint() != ReadableFrames(type(frames._dataset)(str(tmp_path), size=SIZE)).fingerprint()


def test_the_tables_of_a_camera_are_made_once_for_its_image_and_its_mask(tmp_path, monkeypatch):
    """Symptom: every read made them anew, which took longer than all else."""
    made = []
    monkeypatch.setattr(intrinsics, "tables", lambda *given, real=intrinsics.tables: made.append(1) or real(*given))
    data = nerfstudio(tmp_path, -0.15)(str(tmp_path), size=SIZE)
    for row in range(3):
        data.full(row), data[row], data.straight(row, np.zeros(SIZE[::-1], bool))
    assert len(made) == 3


def test_images_of_two_lenses_are_refused(tmp_path, monkeypatch):
    for make in (nerfstudio, colmap):
        root = tmp_path / make.__name__
        monkeypatch.setitem(globals(), "FOCAL", ([130.0, 205.0] * 4)[:COUNT])
        with pytest.raises(ValueError, match=r"of . different cameras .*130.0 to 205.0 px.: map those"):
            make(root, 0.0)(str(root), size=SIZE)

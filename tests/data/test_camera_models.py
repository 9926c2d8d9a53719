"""Cameras of every model of COLMAP; oracles: pycolmap's own camera with its own pixels, OpenCV's two projections."""

import sys

import cv2
import numpy as np
import pytest
from written_scene import center_of_dot, dots

from emgs_jax.data.camera_models import MODELS, Calibration, from_colmap, project, to_pycolmap
from emgs_jax.data.colmap_model import load_cameras, load_colmap
from emgs_jax.data.images import Images
from emgs_jax.data.intrinsics import from_numbers, to_lens
from emgs_jax.data.undistortion import MAX_VIEW_DEG, undistortion

pycolmap = pytest.importorskip("pycolmap", reason="no wheel for Linux on ARM")

SIZE = (160, 120)
CENTER = (78.5, 61.5)  # from the corner, as COLMAP counts
LENSES = {  # in MODELS' order behind the centre
    "SIMPLE_RADIAL": (-0.2,),
    "RADIAL": (-0.2, 0.03),
    "OPENCV": (-0.2, 0.03, 0.002, -0.001),
    "FULL_OPENCV": (-0.2, 0.03, 0.002, -0.001, 0.01, 0.02, -0.01, 0.005),
    "OPENCV_FISHEYE": (0.02, -0.01, 0.005, -0.002),
    "FOV": (0.9,),
    "SIMPLE_RADIAL_FISHEYE": (0.03,),
    "RADIAL_FISHEYE": (0.03, -0.01),
    "THIN_PRISM_FISHEYE": (0.02, -0.01, 0.001, -0.002, 0.005, -0.002, 0.001, -0.001),
    "RAD_TAN_THIN_PRISM_FISHEYE": (0.02, -0.01, 0.003, 0.001, 0, 0, 0.001, -0.001, 0.001, 0, -0.001, 0),
    "SIMPLE_DIVISION": (-0.2,),
    "DIVISION": (-0.2,),
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "EUCM": (0.6, 1.1),
}
POINTS = np.array([[-0.3, -0.22], [0.0, 0.0], [0.31, 0.2], [0.25, -0.2]])  # x, y at depth 1


def params_of(model: str) -> list[float]:
    focal = [90.0] if MODELS[model].startswith("f ") else [90.0, 92.0]
    return [*focal, *CENTER, *LENSES[model]]


def oracle(model: str):
    return pycolmap.Camera(camera_id=1, model=model, width=SIZE[0], height=SIZE[1], params=params_of(model))


def from_corner(model: str, points) -> np.ndarray:
    """Pixels of pycolmap's camera, moved to ours."""
    return oracle(model).img_from_cam(np.column_stack([points, np.ones(len(points))])) - 0.5


def test_models_are_colmaps_in_their_order():
    known = {name: int(number) for name, number in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
    assert [*MODELS] == sorted(known, key=known.get)[: len(MODELS)]
    assert {*LENSES} == {*MODELS} - {"SIMPLE_PINHOLE", "PINHOLE", "EQUIRECTANGULAR"}
    for model in LENSES:
        names = oracle(model).params_info.replace("k,", "k1,").split(", ")
        assert len(names) == len(params_of(model)) == len(MODELS[model].split())


@pytest.mark.parametrize("model", LENSES)
def test_text_binary_and_numbers_are_one_camera_whose_points_are_where_colmap_sees_them(model, tmp_path):
    found = pycolmap.Reconstruction()
    found.add_camera(oracle(model))
    found.write_text(str(tmp_path))
    found.write_binary(str(tmp_path))
    ((_, text),), ((_, binary),) = (load_cameras(tmp_path / f"cameras.{end}").items() for end in ("txt", "bin"))
    assert text == binary and text.size == SIZE
    numbers = params_of(model)
    at = MODELS[model].split().index("cx")
    numbers[at : at + 2] = np.array(CENTER) - 0.5
    assert from_numbers([model, *numbers]) == Calibration(text.intrinsics, text.distortion, None, text.model)
    pixels = project(to_pycolmap(text, SIZE), POINTS)
    np.testing.assert_allclose(pixels, from_corner(model, POINTS), atol=1e-9)
    fx, fy, cx, cy = text.intrinsics
    K, bent = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(text.distortion)
    points = np.column_stack([POINTS, np.ones(len(POINTS))])[:, None]
    if text.model == "OPENCV":
        expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, bent)[0]
    elif model == "OPENCV_FISHEYE":
        expected = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), K, bent)[0]
    else:
        return
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("model", LENSES)
def test_a_straight_image_shows_a_point_where_its_pinhole_camera_sees_it(model, tmp_path):
    cv2.imwrite(str(tmp_path / "1.png"), dots(from_corner(model, POINTS), SIZE))
    camera = from_colmap(model, params_of(model), SIZE, "here")
    (tmp_path / "cameras.txt").write_text(f"1 {model} 160 120 {' '.join(map(str, params_of(model)))}\n")
    dataset = Images(str(tmp_path), size=SIZE, intrinsics=str(tmp_path / "cameras.txt"))
    image, (fx, fy, cx, cy) = dataset[0].image, dataset.intrinsics
    for x, y in POINTS:
        pixel = fx * x + cx, fy * y + cy
        np.testing.assert_allclose(center_of_dot(image, pixel), pixel, atol=0.15)  # the dot's own bending
    assert np.abs(from_corner(model, POINTS) - (POINTS * [fx, fy] + [cx, cy])).max() > 2
    _, maps, share = undistortion(camera, SIZE)
    white = cv2.remap(np.full((*SIZE[::-1], 3), 255, np.uint8), *maps, cv2.INTER_LINEAR)
    assert white.min() > 250 or white.mean() > 254  # no pixel is invented
    is_seen = np.zeros(SIZE[::-1], bool)
    u, v = np.rint(maps).astype(int)
    is_seen[np.clip(v, 0, SIZE[1] - 1), np.clip(u, 0, SIZE[0] - 1)] = True
    filled = cv2.morphologyEx(is_seen.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5)))
    assert share == pytest.approx(filled.mean(), abs=0.03)


@pytest.mark.parametrize("focal", [140.0, 60.0, 30.0])
def test_a_fisheyes_view_ends_at_the_image_or_at_120_degrees(focal):
    """Equidistant: a pixel at r is seen at r / f, to the side 33, 76 and 152 degrees; the last lies behind."""
    lens = to_lens(Calibration((focal, focal, 79.5, 59.5), (), SIZE, "FISHEYE"), SIZE, "here", {})
    side, top = (half / np.tan(min(half / focal, np.radians(MAX_VIEW_DEG / 2))) for half in (79.5, 59.5))
    np.testing.assert_allclose(lens.intrinsics, (max(side, top), max(side, top), 79.5, 59.5))
    assert "FISHEYE: straight images of " in lens.about["note"]


def test_without_pycolmap_straight_images_are_read_and_others_say_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert to_lens(Calibration((90, 90, 80, 60)), SIZE, "here", {}).maps is None
    with pytest.raises(ValueError, match="straightened by pycolmap, which is not installed .*undistort the images"):
        to_lens(Calibration((90, 90, 80, 60), (0.1, 0, 0, 0)), SIZE, "here", {})


def test_poses_of_a_rig_are_those_of_its_cameras(tmp_path):
    """COLMAP 4 writes rigs and frames beside the images, whose poses are still the cameras' own."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 2, 3, 9
    found = pycolmap.synthesize_dataset(options)
    found.write_binary(str(tmp_path))
    assert (tmp_path / "rigs.bin").is_file()
    model = load_colmap(tmp_path)
    poses = {image.name: image.cam_from_world().matrix() for image in found.images.values()}
    np.testing.assert_allclose(np.linalg.inv(model.T_world_camera)[:, :3], [poses[n] for n in model.names], atol=1e-9)
    assert len(model.cameras) == 2 and len({*model.cameras.values()}) == 1  # of the same numbers: one camera

"""Models of a user: cameras, sizes and units that stay, and what is refused; oracle: pycolmap's synthetic scenes."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from scene import compose
from stereo_scene import structure_config

from emgs_jax.config.configure import build
from emgs_jax.data.intrinsics import Pictures
from emgs_jax.structure import sequence
from emgs_jax.structure.given import given_models
from emgs_jax.structure.model import stem, to_structure
from emgs_jax.structure.shots import Shots
from emgs_jax.structure.uncertainty import camera_in_world

NUM, SIZE, FOCAL = 8, (640, 480), 500.0


def scene(num_cameras=1, database=None):
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=num_cameras, num_cameras_per_rig=1, num_points3D=300)
    options.num_frames_per_rig = NUM // num_cameras
    options.camera_width, options.camera_height = SIZE
    options.camera_model_id, options.camera_params = pycolmap.CameraModelId.PINHOLE, [FOCAL, FOCAL, 320.0, 240.0]
    return pycolmap.synthesize_dataset(options, database)


def names_of(model):
    return sorted(stem(image.name) for image in model.images.values())


def taken(names, size=SIZE, is_calibrated=True):
    f = FOCAL * size[0] / SIZE[0]
    blank = np.zeros((size[1], size[0], 3), np.uint8)
    return Shots(names, lambda _: blank, size, ("PINHOLE", (f, f, size[0] / 2, size[1] / 2)), is_calibrated)


def given(tmp_path, model, size=SIZE):
    """The models of a folder for images of a size, and their structure."""
    (tmp_path / "model").mkdir(exist_ok=True)
    model.write_binary(tmp_path / "model")
    config, shots = replace(structure_config(), model=str(tmp_path / "model")), taken(names_of(model), size)
    models = given_models(tmp_path / "model", shots, config)
    return models, to_structure(models, shots.names, config)


@pytest.mark.parametrize("size", [(320, 240), (1280, 960)])
def test_a_model_of_smaller_or_larger_images_has_the_camera_of_these(tmp_path, size):
    whole, _ = given(tmp_path, scene())
    models, found = given(tmp_path, scene(), size)
    camera, scale = found.worlds[0].camera, size[0] / SIZE[0]
    np.testing.assert_allclose(camera.params, np.array([FOCAL, FOCAL, 320, 240]) * scale)
    models[0].update_point_3d_errors()
    assert models[0].compute_mean_reprojection_error() < 1e-3  # its keypoints are of these images, too
    assert whole[0].num_reg_images() == models[0].num_reg_images() == NUM
    with pytest.raises(ValueError, match="of images of 640x480, which are no copies of those of 640x360"):
        given(tmp_path, scene(), (640, 360))


def test_intrinsics_that_are_estimated_by_a_model_are_those_of_the_images_on_disk(tmp_path, monkeypatch):
    scene().write_binary(tmp_path)
    names = names_of(scene())
    monkeypatch.setattr(sequence, "image_names", lambda *_: names)
    pictures = Pictures((320, 240), NUM, lambda _: np.zeros((240, 320, 3), np.uint8))
    camera, _ = sequence.calibrate(pictures, replace(structure_config(), model=str(tmp_path)))
    np.testing.assert_allclose(camera.intrinsics, (FOCAL / 2, FOCAL / 2, 159.5, 119.5))


@pytest.mark.parametrize(("spread", "is_one"), [(0.001, True), (0.05, False)])
def test_cameras_that_are_alike_are_one_and_others_are_refused(tmp_path, spread, is_one):
    model = scene(NUM)
    for row, camera in enumerate(model.cameras.values()):
        camera.params = [FOCAL * (1 + spread * (row - 3)), FOCAL * (1 + spread * (row - 3)), 320.0, 240.0]
    if not is_one:
        with pytest.raises(ValueError, match=r"of 8 different cameras .focal lengths of 425.0 to 600.0 px.: map those"):
            given(tmp_path, model)
        return
    _, found = given(tmp_path, model)
    (world,) = found.worlds
    assert world.camera.params[0] == pytest.approx(FOCAL, rel=1e-3)


@pytest.mark.parametrize(("factor", "stays"), [(1.0, True), (0.3, True), (1000.0, False)])
def test_the_unit_of_a_model_stays_unless_it_is_millimetres(tmp_path, capsys, factor, stays):
    model = scene()
    model.transform(pycolmap.Sim3d(factor, pycolmap.Rotation3d(), np.zeros(3)))
    truth = np.array([image.projection_center() for image in sorted(model.images.values(), key=lambda i: i.name)])
    _, found = given(tmp_path, model)
    step, true_step = (np.linalg.norm(x[3] - x[0]) for x in (found.T_world_camera[:, :3, 3], truth))
    said = "".join(capsys.readouterr())
    assert (step == pytest.approx(true_step, rel=1e-3)) == stays
    assert ("its unit stays" in said) == stays and ("its unit is changed" in said) != stays
    depths = np.concatenate([found.depths(frame) for frame in range(NUM)])
    assert stays or np.median(depths) == pytest.approx(structure_config().median_depth)


@pytest.mark.parametrize(("factor", "words"), [(1.0, ()), (8.0, ()), (8.0, ("scale.height=1.5",))])
def test_a_metre_of_the_settings_is_that_of_an_own_structure(tmp_path, factor, words):
    """Symptom: in a model whose images look 10 far, covariances had a floor of a fifth, and walls were double."""
    model = scene()
    model.transform(pycolmap.Sim3d(factor, pycolmap.Rotation3d(), np.zeros(3)))
    _, found = given(tmp_path, model)
    prior = build(compose("prior=multiview_stereo", f"prior.structure.model={tmp_path}/model", *words), "prior")
    prior._take = lambda frame: found
    own = build(compose("prior=multiview_stereo"), "prior")
    depths = np.median([np.median(found.depths(frame)) for frame in range(NUM)])
    assert own.metre == 1.0 and prior.metre == (1.0 if words else pytest.approx(depths / 2.0))


def test_a_database_is_mapped_by_the_camera_that_is_known_and_says_so(tmp_path, capsys):
    path = tmp_path / "database.db"
    with pycolmap.Database.open(path) as database:
        model = scene(1, database)
        for camera in database.read_all_cameras():
            camera.params, camera.has_prior_focal_length = [768.0, 768.0, 320.0, 240.0], False
            database.update_camera(camera)
    config = replace(structure_config("prior.structure.refine_distortion=false"), model=str(path))
    for size in (SIZE, (320, 240)):
        (found,) = given_models(path, taken(names_of(model), size), config)
        (camera,) = found.cameras.values()
        assert camera.params[0] == pytest.approx(FOCAL * size[0] / SIZE[0]) and camera.width == size[0]
        assert found.num_reg_images() == NUM and found.compute_mean_reprojection_error() < 0.01
    assert "focal length of 500.0 px counts, not its own of 768.0" in "".join(capsys.readouterr())


def test_images_that_are_not_in_use_or_show_no_point_change_nothing(tmp_path, capsys):
    """Symptoms: a metric model lost its unit by an image without points; a camera that no image in use has counted."""
    model = scene(2)
    names = names_of(model)
    for number, camera in enumerate(sorted(model.cameras.values(), key=lambda one: one.camera_id)):
        if number:
            camera.width, camera.height, camera.params = 300, 500, [9 * FOCAL, 9 * FOCAL, 150.0, 250.0]
    first = min(model.cameras)
    used = sorted(stem(image.name) for image in model.images.values() if image.camera_id == first)
    bare = next(image for image in model.images.values() if stem(image.name) == used[0])
    for point in [point.point3D_id for point in bare.points2D if point.has_point3D()]:
        model.delete_point3D(point)
    model.write_binary(tmp_path)
    config, shots = replace(structure_config(), model=str(tmp_path)), taken(used)
    found = to_structure(given_models(tmp_path, shots, config), used, config)
    assert "its unit stays" in "".join(capsys.readouterr()) and len(used) == NUM // 2 < len(names)
    assert found.worlds[0].camera.params[0] == FOCAL


def test_the_camera_that_is_estimated_is_of_the_images_in_use(tmp_path, monkeypatch):
    model = scene(2)
    for number, camera in enumerate(sorted(model.cameras.values(), key=lambda one: one.camera_id)):
        camera.params = [FOCAL * (1 + number), FOCAL * (1 + number), 320.0, 240.0]
    model.write_binary(tmp_path)
    for number, key in enumerate(sorted(model.cameras)):
        used = sorted(stem(image.name) for image in model.images.values() if image.camera_id == key)
        monkeypatch.setattr(sequence, "image_names", lambda *_, used=used: used)
        pictures = Pictures(SIZE, len(used), lambda _: np.zeros((480, 640, 3), np.uint8))
        camera, about = sequence.calibrate(pictures, replace(structure_config(), model=str(tmp_path)))
        assert camera.intrinsics[0] == FOCAL * (1 + number) and about["num_images"] == len(used)


def named(model, name):
    for number, image in enumerate(sorted(model.images.values(), key=lambda one: one.name)):
        image.name = name.format(number)
    return model


def radial(model):
    """The camera bends a little; its images are taken as they are, so points no longer fall on their keypoints."""
    for camera in model.cameras.values():
        camera.model, camera.params = pycolmap.CameraModelId.SIMPLE_RADIAL, [FOCAL, 320.0, 240.0, -0.01]
    return model


def lacking(model, rows):
    for image in [image for number, image in enumerate(by_name(model)) if number in rows]:
        model.deregister_frame(image.frame_id)
    return model


def by_name(model):
    return sorted(model.images.values(), key=lambda one: one.name)


def written(models, place, as_text=False):
    for number, model in enumerate(models):
        folder = place / str(number) if len(models) > 1 else place
        folder.mkdir(parents=True, exist_ok=True)
        model.write_text(folder) if as_text else model.write_binary(folder)
    return place


# What a user brings; which frames have a pose in it, and the names of this run's images.
SITUATIONS = {
    "binary": (lambda p: written([scene()], p), range(NUM), None),
    "text": (lambda p: written([scene()], p, as_text=True), range(NUM), None),
    "names in folders": (lambda p: written([named(scene(), "cam/left/{:03d}.JPG")], p), range(NUM), "{:03d}"),
    "names with points": (lambda p: written([named(scene(), "170.{:03d}.png")], p), range(NUM), "170.{:03d}"),
    "names without ends": (lambda p: written([named(scene(), "f{:03d}")], p), range(NUM), "f{:03d}"),
    "images missing": (lambda p: written([lacking(scene(), (0, 5))], p), (1, 2, 3, 4, 6, 7), None),
    "a bent camera": (lambda p: written([radial(scene())], p), range(NUM), None),
    "several models": (
        lambda p: written([lacking(scene(), (5, 6, 7)), lacking(scene(), range(5))], p, as_text=True),
        range(NUM),
        None,
    ),
}


@pytest.mark.parametrize("size", [SIZE, (320, 240), (1280, 960)])
@pytest.mark.parametrize("kind", SITUATIONS)
def test_a_model_keeps_its_poses_its_world_its_unit_and_its_camera(tmp_path, capsys, kind, size):
    """Right, whatever the files, names and sizes: poses as they are, no pose where there is none, its own camera."""
    write, placed, name = SITUATIONS[kind]
    truth = np.array([camera_in_world(image) for image in by_name(scene())])
    names = names_of(scene()) if name is None else [name.format(row) for row in range(NUM)]
    config = replace(structure_config(), model=str(write(tmp_path / "model")))
    models = given_models(tmp_path / "model", taken(names, size), config)
    found = to_structure(models, names, config)
    assert np.flatnonzero(found.is_placed).tolist() == [*placed]
    rows = [*placed]
    np.testing.assert_allclose(found.T_world_camera[rows], truth[rows], atol=1e-9)
    assert "its unit stays" in "".join(capsys.readouterr())
    for world in found.worlds:
        lens = [FOCAL, 320, 240] if kind == "a bent camera" else [FOCAL, FOCAL, 320, 240]
        np.testing.assert_allclose(world.camera.params[: len(lens)], np.array(lens) * size[0] / SIZE[0])
        assert (world.camera.width, world.camera.height) == size
    assert len(found.worlds) == (2 if kind == "several models" else 1)

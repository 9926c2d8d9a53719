"""What is made of COLMAP's models, those of others included; oracles: pycolmap's synthetic scenes and noise."""

import gc
import tempfile

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from stereo_scene import shots, structure_config

from emgs_jax.structure.given import given_models, read_models
from emgs_jax.structure.mapping import Mapped, drop_points_at_cameras
from emgs_jax.structure.model import NONE, stem, to_structure
from emgs_jax.structure.shots import DATABASE
from emgs_jax.structure.store import doubtful_in, make_models, write_models
from emgs_jax.structure.uncertainty import camera_in_world

NUM_FRAMES = 8


def scene(seed=0, database=None):
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=NUM_FRAMES, num_points3D=80
    )
    return pycolmap.synthesize_dataset(options, database)


def names_of(model):
    return sorted(stem(image.name) for image in model.images.values())


def part(model, rows):
    """The model with some of its frames alone."""
    found, names = pycolmap.Reconstruction(model), names_of(model)
    for image in list(found.images.values()):
        if names.index(stem(image.name)) not in rows:
            found.deregister_frame(image.frame_id)
    with tempfile.TemporaryDirectory() as folder:  # what is without a pose is not written
        found.write_binary(folder)
        return pycolmap.Reconstruction(folder)


def poses_of(model):
    return np.stack([camera_in_world(image) for image in sorted(model.images.values(), key=lambda one: one.name)])


def test_every_model_is_a_world_in_the_order_of_first_frames_and_a_frame_is_of_the_largest_that_holds_it():
    whole = scene()
    found = to_structure([part(whole, range(3, 8)), part(whole, (0, 1, 3))], names_of(whole), structure_config())
    assert found.world.tolist() == [0, 0, NONE, 1, 1, 1, 1, 1]
    assert np.isnan(found.T_world_camera[2]).all(), "2 lies between two worlds"
    true = np.linalg.inv(poses_of(whole)[3]) @ poses_of(whole)[3:]
    mine = np.linalg.inv(found.T_world_camera[3]) @ found.T_world_camera[3:]
    np.testing.assert_allclose(mine[:, :3, :3], true[:, :3, :3], atol=1e-9)
    unit = np.linalg.norm(mine[4, :3, 3]) / np.linalg.norm(true[4, :3, 3])
    np.testing.assert_allclose(mine[:, :3, 3], unit * true[:, :3, 3], atol=1e-9)
    for world in (0, 1):
        depths = np.concatenate([found.depths(frame) for frame in np.flatnonzero(found.world == world)])
        assert np.median(depths) == pytest.approx(2.0)


@pytest.mark.slow
def test_the_covariance_is_that_of_the_poses_errors():
    """Normalised estimation error squared, of the pose relative to the one before up to the unit that fits best."""
    config, whole, found = structure_config("prior.structure.pixel_std=0.001"), scene(), []
    truth, names = np.linalg.inv(poses_of(whole)[0]) @ poses_of(whole), names_of(whole)
    options = pycolmap.BundleAdjustmentOptions(refine_focal_length=False, refine_extra_params=False)
    for draw in range(12):
        noisy = pycolmap.Reconstruction(whole)
        pycolmap.set_random_seed(draw + 1)
        pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=1.0), noisy)
        pycolmap.bundle_adjustment(noisy, options)
        made = to_structure([noisy], names, config)
        T = np.linalg.inv(made.T_world_camera[0]) @ made.T_world_camera
        unit = (T[:, :3, 3] * truth[:, :3, 3]).sum() / (truth[:, :3, 3] ** 2).sum()
        for row in range(1, NUM_FRAMES):
            moved, true = (np.linalg.inv(poses[row - 1]) @ poses[row] for poses in (T, truth))
            turn = Rotation.from_matrix(moved[:3, :3].T @ true[:3, :3]).as_rotvec()
            xi = np.concatenate([moved[:3, :3].T @ (unit * true[:3, 3] - moved[:3, 3]), turn])
            found.append(xi @ np.linalg.solve(made.covariance[row], xi) / 6)
    assert 0.7 < np.mean(found) < 1.4


def test_models_without_points_or_of_two_images_have_poses_and_no_covariance(capfd):
    """Symptom: a matrix product of None; and COLMAP's warnings on the terminal."""
    bare = scene()
    for key in list(bare.points3D):
        bare.delete_point3D(key)
    for model in (bare, part(scene(), (0, 1))):
        found = to_structure([model], names_of(bare), structure_config())
        assert (found.world[:2] == 0).all() and np.isnan(found.covariance[1]).all()
    assert capfd.readouterr().err == ""


@pytest.fixture
def given(tmp_path):
    """The synthetic images, and a function that names a model of theirs."""
    whole = scene()
    taken = shots([None] * NUM_FRAMES, names=names_of(whole))
    taken = taken._replace(camera=("SIMPLE_RADIAL", (200.0, 80.0, 60.0, 0.05)))  # the scene's, at the size of these
    return whole, taken, lambda path: given_models(path, taken, structure_config(f"prior.structure.model='{path}'"))


def test_a_model_is_taken_from_a_folder_numbered_folders_text_and_a_runs_own(tmp_path, given):
    whole, taken, models = given
    for name in ("one", "text", "several/0", "several/1"):
        (tmp_path / name).mkdir(parents=True)
    whole.write_binary(tmp_path / "one")
    whole.write_text(tmp_path / "text")
    part(whole, (0, 1, 2)).write_binary(tmp_path / "several/0")
    part(whole, range(3, 8)).write_binary(tmp_path / "several/1")
    write_models(Mapped([part(whole, (0, 1, 2))], [], frozenset({"000001.png"})), "key", tmp_path / "structure")
    assert doubtful_in(tmp_path / "structure") == {"000001"} and doubtful_in(tmp_path) is None is doubtful_in(None)
    for name, counts in (("one", [8]), ("text", [8]), ("several", [5, 3]), ("structure", [3])):
        assert [model.num_reg_images() for model in models(tmp_path / name)] == counts
    config = structure_config(f"prior.structure.model={tmp_path}/one")
    _, kept = make_models(taken, config, tmp_path / "run/structure")
    assert [model.num_reg_images() for model in read_models(tmp_path / "run/structure")] == [8]
    np.testing.assert_array_equal(poses_of(kept[0]), poses_of(whole))


@pytest.mark.slow
def test_a_database_is_mapped_and_stays_as_it_is(tmp_path, given):
    _, _, models = given
    with pycolmap.Database.open(tmp_path / DATABASE) as database:
        scene(database=database)
    before = (tmp_path / DATABASE).read_bytes()
    (found,) = models(tmp_path)
    assert found.num_reg_images() == NUM_FRAMES and models(tmp_path / DATABASE)
    assert (tmp_path / DATABASE).read_bytes() == before and len([*tmp_path.iterdir()]) == 1


@pytest.mark.slow
def test_a_camera_that_is_wrong_is_named_where_no_model_agrees_with_the_matches(tmp_path, given):
    whole, taken, _ = given
    with pycolmap.Database.open(tmp_path / DATABASE) as database:
        scene(database=database)
    wrong = taken._replace(camera=("SIMPLE_RADIAL", (131.2, 80.0, 60.0, 0.0)))
    with pytest.raises(ValueError, match="its camera may be another .dataset.intrinsics=estimate"):
        given_models(tmp_path / DATABASE, wrong, structure_config(f"prior.structure.model='{tmp_path}'"))


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_a_file_that_ends_too_soon_is_named(tmp_path, name):
    """Symptom: pycolmap read on behind the end for ever, and took gigabytes for it."""
    scene().write_binary(tmp_path)
    assert read_models(tmp_path)[0].num_reg_images() == NUM_FRAMES
    path = tmp_path / f"{name}.bin"
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(ValueError, match=f"{name}.bin is damaged: it ends within a record"):
        read_models(tmp_path)


def test_the_lens_of_a_world_outlives_the_model_that_it_is_from():
    """It was a view of the model's memory: frames had no valid point, or the process ended."""
    model = scene()
    given, names = [*next(iter(model.cameras.values())).params], names_of(model)
    structure = to_structure([model], names, structure_config())
    del model
    gc.collect()
    [scene(seed) for seed in (1, 2)]
    np.testing.assert_array_equal(structure.worlds[0].camera.params, given)


def test_a_point_at_a_camera_is_dropped_and_all_poses_keep_a_covariance():
    """One such point of 5,653 left 40 of 120 frames of a flat without a covariance."""
    model = scene()
    first = next(image for image in model.images.values() if image.num_points3D > 2)
    number = next(row for row, point in enumerate(first.points2D) if point.has_point3D())
    bad = first.points2D[number].point3D_id
    model.points3D[bad].xyz = first.projection_center() + 1e-9
    drop_points_at_cameras(model)
    assert bad not in model.points3D and model.num_points3D() > 70
    structure = to_structure([model], names_of(model), structure_config())
    assert np.isfinite(structure.covariance).all()

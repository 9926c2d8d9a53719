"""A model at poses that are known but for their errors; oracles: pycolmap's synthetic scenes, and a rendered room."""

from types import MappingProxyType

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from stereo_scene import room, shots, similarity_error, structure_config

from emgs_jax.data.masks import stem
from emgs_jax.structure import sequence, store
from emgs_jax.structure.model import to_structure
from emgs_jax.structure.posed import model_at
from emgs_jax.structure.shots import DATABASE
from emgs_jax.structure.store import key_of, make_models
from emgs_jax.structure.uncertainty import camera_in_world

COUNT = 12
NOISE, TURN_DEG = 0.05, 0.5  # of the poses; the scene is some ten wide


@pytest.fixture
def scene(tmp_path):
    """Shots without poses, true poses, and a folder with a database."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_cameras_per_rig=1,
        num_frames_per_rig=COUNT,
        num_points3D=150,
        camera_has_prior_focal_length=True,
    )
    with pycolmap.Database.open(tmp_path / DATABASE) as database:
        model = pycolmap.synthesize_dataset(options, database)
        pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5), model, database)
    images = sorted(model.images.values(), key=lambda image: image.name)
    camera = images[0].camera
    taken = shots([None] * COUNT, names=[stem(image.name) for image in images])
    taken = taken._replace(size=(camera.width, camera.height))
    return taken, np.stack([camera_in_world(image) for image in images]), tmp_path


def disturbed(poses, seed=0, noise=NOISE):
    rng, found = np.random.default_rng(seed), poses.copy()
    found[:, :3, 3] += noise * rng.normal(size=(len(poses), 3))
    turns = Rotation.from_rotvec(np.radians(TURN_DEG) * rng.normal(size=(len(poses), 3)))
    found[:, :3, :3] = found[:, :3, :3] @ turns.as_matrix()
    return found


def poses_in(model, names):
    rows = {stem(image.name): camera_in_world(image) for image in model.images.values() if image.has_pose}
    return np.stack([rows.get(name, np.full((4, 4), np.nan)) for name in names])


def off(found, truth):
    """Root mean square error of positions and turns (degrees), in the truth's own world."""
    turns = Rotation.from_matrix(np.swapaxes(truth[:, :3, :3], 1, 2) @ found[:, :3, :3]).magnitude()
    positions = np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1)
    return float(np.sqrt(np.mean(positions**2))), float(np.degrees(np.sqrt(np.mean(turns**2))))


def test_the_model_is_in_the_poses_world_and_unit_and_nearer_to_the_truth_than_they(scene):
    taken, truth, folder = scene
    given = disturbed(truth)
    made = model_at(taken._replace(poses=given), structure_config(), folder)
    found, before = off(poses_in(made.models[0], taken.names), truth), off(given, truth)
    assert found[0] < 0.6 * before[0] and found[1] < 0.6 * before[1]
    assert "at the data set's poses, whose positions are off by 0.0" in made.said[-1]


def test_a_wrong_pose_is_named_and_found_anew_and_one_that_is_missing_is_found(scene):
    taken, truth, folder = scene
    given = disturbed(truth)
    given[3, :3, :3] = given[3, :3, :3] @ Rotation.from_rotvec([0.3, 0.3, 0.0]).as_matrix()
    given[3, :3, 3] += [1.0, -1.0, 0.5]
    given[8] = np.nan
    made = model_at(taken._replace(poses=given), structure_config(), folder)
    found = poses_in(made.models[0], taken.names)
    assert taken.names[3] in made.said[0] and "(images in all: 1)" in made.said[0]
    each = np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert (each[[3, 8]] < NOISE).all() and off(found, truth)[0] < 0.6 * NOISE * 3**0.5


@pytest.mark.parametrize("words", ["of others", "few"])
def test_poses_that_the_matches_contradict_or_that_are_few_are_not_used(scene, words, capfd):
    taken, truth, folder = scene
    given = disturbed(truth)
    if words == "few":
        given[5:] = np.nan
    else:
        given = given[np.random.default_rng(0).permutation(COUNT)]
    assert model_at(taken._replace(poses=given), structure_config(), folder) is None
    said = capfd.readouterr()
    assert ("the data set's poses are not used" in said.out + said.err) == (words == "of others")


@pytest.mark.slow
def test_a_structure_of_images_at_their_poses(tmp_path, monkeypatch):
    """Exact poses, too, which lie in a plane."""
    monkeypatch.setattr(store, "CACHE", tmp_path / "cache")
    taken, config = shots([frame.image for frame in room()]), structure_config()
    truth = np.stack([frame.T_world_camera for frame in room()])
    given = taken._replace(poses=truth)
    assert key_of(given, config) != key_of(taken, config)
    _, (model,) = make_models(given, config, tmp_path / "structure")
    found = poses_in(model, taken.names)
    assert off(found, truth)[0] < 0.002  # m
    made = to_structure([model], taken.names, config)
    assert similarity_error(made.T_world_camera[:, :3, 3], truth[:, :3, 3]) < 0.002


class Posed(list):
    """Poses as a data set."""

    calibration, full_intrinsics, size, intrinsics = MappingProxyType({}), None, (160, 120), (131.2, 131.2, 79.5, 59.5)

    def pose(self, index):
        return self[index]


@pytest.mark.parametrize("at_poses", [False, True])
def test_a_data_sets_poses_are_those_of_its_shots(monkeypatch, at_poses):
    """The second frame has none."""
    T = np.stack([frame.T_world_camera for frame in room()])
    dataset = Posed([T[0], None, T[2]])
    taken = []
    monkeypatch.setattr(sequence, "names_of", lambda dataset: ["a", "b", "c"])
    monkeypatch.setattr(sequence, "make_models", lambda shots, *given: taken.append(shots) or ("key", []))
    sequence.structure_of(dataset, structure_config(), None, at_poses)
    (found,) = taken
    assert (found.poses is None) != at_poses
    if at_poses:
        np.testing.assert_array_equal(found.poses[[0, 2]], T[[0, 2]])
        assert np.isnan(found.poses[1]).all()

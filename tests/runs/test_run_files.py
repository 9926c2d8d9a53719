"""The files of a run; oracles: other programs' readers, a wall whose every property is known."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import trimesh
from hand_run import STATUSES, densify_config, hand_run, poses_along, random_poses, wall

from emgs_jax.drawing.layers import closing_covariances
from emgs_jax.evaluation.clouds import PointCloud
from emgs_jax.evaluation.segmentation import LabelledPoints
from emgs_jax.io.map_file import load_map
from emgs_jax.io.trajectory import load_trajectory_tum
from emgs_jax.runs.dense import DenseMap
from emgs_jax.runs.files import OUTPUTS, claim_folder, save_outputs, save_progress

NUM_FRAMES = len(STATUSES)
ESTIMATE, TRUTH = (228, 87, 46), (27, 153, 139)  # colours of the paths


def finished(true_poses=None, gaussians=None):
    poses = poses_along(np.linspace(0.0, 1.0, NUM_FRAMES))
    true_poses = [None] * NUM_FRAMES if true_poses is None else true_poses
    return hand_run(poses, poses_along(np.full(NUM_FRAMES, 9.0)), true_poses, gaussians=gaussians)


def dense_map() -> DenseMap:
    """Two points, one of them without a class."""
    points = np.array([[0.1, 0.2, 2.0], [0.4, -0.3, 2.0]])
    cloud = PointCloud(points, np.array([[0.0, 0.0, -1.0]] * 2), np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    return DenseMap(cloud, LabelledPoints(points, np.array([1, -1]), ("floor", "wall")))


def vertices(path):
    return trimesh.load(path).metadata["_ply_raw"]["vertex"]["data"]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A run whose outputs and progress are written, and their folder; the first frame's true pose is unknown."""
    folder, truth = tmp_path_factory.mktemp("run"), poses_along(np.linspace(0.0, 1.0, NUM_FRAMES) + 0.3)
    run = finished([None, *truth[1:]])
    config = densify_config("render.opacity=0.75")
    assert save_outputs(folder, run, dense_map(), config, "a wall", True) == []
    save_progress(folder, run)
    return run, folder


def test_the_progress_is_the_map_bit_for_bit_and_our_poses_at_the_frames_times(tmp_path):
    run = finished()
    run.poses[:] = random_poses(np.random.default_rng(0), NUM_FRAMES)
    save_progress(tmp_path, run)
    times, poses = load_trajectory_tum(tmp_path / "trajectory.txt")
    placed = [row for row, record in enumerate(run.records) if record.status != "lost"]  # a lost pose is a guess
    assert len(placed) == NUM_FRAMES - 1
    np.testing.assert_array_equal(times, [run.records[row].timestamp for row in placed])
    np.testing.assert_allclose(poses, np.stack(run.poses)[placed], atol=5e-9)  # nine digits are written
    loaded = load_map(tmp_path / "map.npz")
    for name in ("means", "covs", "colors", "normals", "features", "valid"):
        np.testing.assert_array_equal(getattr(loaded.gaussians, name), getattr(run.state.map.gaussians, name))


def test_the_poses_of_a_long_run_are_stacked_once(tmp_path):
    """Symptom: once a frame, and each was kept: 15 GB at the end of an hour of a camera."""
    run, num_stacked = finished(), []

    class Counted(SimpleNamespace):
        @property
        def poses(self):
            num_stacked.append(1)
            return run.poses

    save_progress(tmp_path, Counted(**{name: value for name, value in vars(run).items() if name != "poses"}))
    assert (tmp_path / "trajectory.txt").exists() and len(num_stacked) == 1


def test_before_there_is_a_map_nothing_is_written(tmp_path):
    run = finished()
    run.state = run.map = None
    save_progress(tmp_path, run)
    assert list(tmp_path.iterdir()) == []


def test_map_ply_holds_the_gaussians_in_use_as_they_are_drawn(written):
    """The covariances are those that close the surface and stay as thick, the opacity is the drawing's."""
    run, folder = written
    gaussians = run.state.map.gaussians
    valid = np.asarray(gaussians.valid)
    rows = vertices(folder / "map.ply")
    assert len(rows["x"]) == valid.sum() < len(valid)
    found = np.stack([np.ravel(rows[axis]) for axis in "xyz"], axis=1)
    np.testing.assert_array_equal(found, np.asarray(gaussians.means)[valid])
    scales = np.sort(np.stack([np.ravel(rows[f"scale_{i}"]) for i in range(3)], axis=1))
    covs = closing_covariances(*(np.asarray(x)[valid] for x in (gaussians.means, gaussians.covs, gaussians.normals)))
    np.testing.assert_allclose(np.exp(scales), np.sqrt(np.linalg.eigvalsh(covs)), rtol=1e-5)
    np.testing.assert_allclose(np.exp(scales[:, 0]), 1e-2, rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-np.ravel(rows["opacity"]))), 0.75, rtol=1e-6)
    np.testing.assert_array_equal(np.ravel(rows["nz"]), -1.0)
    red = 0.5 + 0.28209479177387814 * np.ravel(rows["f_dc_0"])
    np.testing.assert_allclose(20.0 * red, found[:, 0], atol=1e-5)


def test_points_ply_is_the_dense_cloud_with_its_classes(written):
    _, folder = written
    rows, dense = vertices(folder / "points.ply"), dense_map()
    np.testing.assert_allclose(np.stack([np.ravel(rows[axis]) for axis in "xyz"], 1), dense.cloud.points, rtol=1e-6)
    np.testing.assert_array_equal(np.ravel(rows["nz"]), -1.0)
    np.testing.assert_array_equal(np.ravel(rows["red"]), [255, 0])
    np.testing.assert_array_equal(np.ravel(rows["label"]), [1, -1])
    assert b"comment label 0 floor\ncomment label 1 wall\n" in (folder / "points.ply").read_bytes()


def test_the_mesh_is_the_wall_seen_from_the_cameras_side(written):
    mesh = trimesh.load(written[1] / "mesh.ply")
    np.testing.assert_allclose(mesh.vertices[:, 2], 2.0, atol=0.02)
    towards = np.average(mesh.face_normals[:, 2], weights=mesh.area_faces)
    assert towards < -0.95, f"the faces' mean normal is {towards:+.2f} along the view"
    assert 1.0 < mesh.area < 3.0  # 1 m x 2 m, and its rim


def test_every_file_that_a_run_writes_is_known_as_an_output(written):
    names = {"map.ply", "points.ply", "mesh.ply", "overview.png", "trajectory.txt", "map.npz"}
    assert {path.name for path in written[1].iterdir()} == names <= set(OUTPUTS)


def test_what_could_not_be_made_is_named_and_without_classes_or_truth_there_are_none(written, tmp_path):
    run = finished(gaussians=wall(0.0, 0.2))  # 40 Gaussians
    (note,) = save_outputs(tmp_path, run, DenseMap(dense_map().cloud), densify_config(), "a wall", True)
    assert note.startswith("no mesh.ply: 40 points") and not (tmp_path / "mesh.ply").exists()
    assert {path.name for path in tmp_path.iterdir()} == {"map.ply", "points.ply", "overview.png"}
    assert "label" not in vertices(tmp_path / "points.ply").dtype.names
    for folder, is_known in ((written[1], True), (tmp_path, False)):
        image = cv2.imread(str(folder / "overview.png"))[..., ::-1].astype(int)
        estimate, truth = (np.all(np.abs(image - color) <= 8, axis=-1).mean() for color in (ESTIMATE, TRUTH))
        assert estimate > 1e-4 and (truth > 1e-4) == is_known


@pytest.fixture
def drawn(monkeypatch):
    """What the overviews that are written now show as paths."""
    paths = []
    monkeypatch.setattr("emgs_jax.drawing.overview.draw_overview", lambda path, cloud, shown, *_: paths.append(shown))
    monkeypatch.setattr("emgs_jax.runs.files.save_mesh_ply", lambda *_: None)
    return paths


@pytest.mark.parametrize("with_scale", [True, False])
def test_the_overview_shows_the_true_path_where_the_estimate_fits_it_best(with_scale, tmp_path, drawn):
    """A map in another frame and unit is not drawn as one that drifts."""
    unknown, turned = 2, np.eye(4)
    turned[:3, :3] = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    bent = poses_along(np.linspace(0.0, 1.0, NUM_FRAMES))
    bent[:, 1, 3] = bent[:, 0, 3] ** 2  # a straight path leaves its roll open
    truth = turned @ bent
    truth[:, :3, 3] = 2.0 * truth[:, :3, 3] + [5.0, -3.0, 1.0]
    run = finished([None if row == unknown else pose for row, pose in enumerate(truth)])
    run.poses[:] = bent
    save_outputs(tmp_path, run, dense_map(), densify_config(), "a wall", with_scale)
    (paths,) = drawn
    known = np.arange(NUM_FRAMES) != unknown
    middle = bent[known & [record.status != "lost" for record in run.records], :3, 3].mean(0)
    expected = bent[known].copy()
    expected[:, :3, 3] = middle + (1.0 if with_scale else 2.0) * (bent[known, :3, 3] - middle)
    np.testing.assert_allclose(paths.truth[known], expected, atol=1e-9)
    assert np.isnan(paths.truth[unknown]).all()


def test_the_overview_shows_loops_between_the_frames_of_the_back_end_and_the_path_before(tmp_path, drawn):
    run, later = finished(), poses_along(np.full(NUM_FRAMES - 2, 5.0))
    loops = [SimpleNamespace(a=3, b=5), SimpleNamespace(a=1, b=5)]  # the first three nodes are a saved map's
    nodes = [SimpleNamespace(online=pose + 1.0) for pose in (*[np.eye(4)] * 3, *later)]
    run.back_end = SimpleNamespace(accepted=loops, closures=[None], nodes=nodes, first_node=3)
    save_outputs(tmp_path, run, dense_map(), densify_config(), "a wall", True)
    run.back_end.closures = []  # as where frames are only located in a saved map: its loops are there, and no node
    save_outputs(tmp_path, run, dense_map(), densify_config(), "a wall", True)
    (paths, without) = drawn
    assert paths.loops == ((2, 4),) and without.loops == () and without.online is None
    np.testing.assert_array_equal(paths.online, later + 1.0)
    np.testing.assert_array_equal(paths.is_placed, [status != "lost" for status in STATUSES])


def test_a_new_run_never_lies_beside_the_outputs_of_another(tmp_path):
    """A second run that ended early left its trajectory beside the metrics of the first."""
    assert claim_folder(tmp_path) == []
    for text, target in (("first", "previous-1"), ("second", "previous-2")):
        for name in (*OUTPUTS, "notes.txt"):
            (tmp_path / name).write_text(text)
        (note,) = claim_folder(tmp_path)
        assert note.endswith(f"they are in {tmp_path / target} now")
        assert {path.name for path in (tmp_path / target).iterdir()} == set(OUTPUTS)
        assert {path.read_text() for path in (tmp_path / target).iterdir()} == {text}
        assert not any((tmp_path / name).exists() for name in OUTPUTS) and (tmp_path / "notes.txt").exists()

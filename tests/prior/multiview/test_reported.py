"""What `multiview_stereo` reports of its structure, in metres or not; the structure is drawn by hand."""

import json

import numpy as np
import pytest
from scene import compose

from emgs_jax.config.configure import build
from emgs_jax.prior.base import UP_KEYS, Window
from emgs_jax.prior.multiview import prior as module
from emgs_jax.prior.multiview.dense import Depth
from emgs_jax.scale.estimate import Scale
from emgs_jax.scale.metres import Metres
from emgs_jax.structure.model import NONE, Structure, World

TURN = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # of the first camera with a pose
UP = np.array([0.0, 0.6, 0.8])


class Photos:
    """Four frames `p0.jpg` …"""

    def __init__(self, folder):
        self.folder = folder

    def __len__(self):
        return 4

    def files(self, index):
        return [self.folder / f"p{index}.jpg"]


def drawn(world=(NONE, 0, 0, 0)):
    """The first frame has no pose."""
    T = np.full((4, 4, 4), np.nan)
    T[1:] = np.eye(4)
    T[1, :3, :3] = TURN
    worlds = [World(np.zeros((0, 3)), None)] * (max(world) + 1)
    return Structure(worlds, np.array(world), T, np.zeros((4, 6, 6)), [np.zeros(0, int)] * 4)


def begun(folder, *words):
    prior = build(compose("prior=multiview_stereo", *words), "prior")
    prior._dataset, prior._folder, prior._known = Photos(folder), folder / "structure", drawn()
    prior._depths = lambda frame: None
    return prior


def test_up_by_a_source_of_the_scale_is_reported_in_the_first_cameras_axes(tmp_path, monkeypatch):
    prior = begun(tmp_path, "scale.height=1.5")
    assert {"prior/scale_std_percent", *UP_KEYS}.isdisjoint(prior.report())
    for up in (None, UP):
        found = Metres(Scale("height", np.log(2.0), 0.03), up, ())
        monkeypatch.setattr(module, "metres_of", lambda *given, found=found: [found])
        prior._to_metres(drawn(), ())
        report = prior.report()
        assert report["prior/scale_std_percent"] == pytest.approx(3.0)
        assert (UP_KEYS[0] in report) == (up is not None)
    *up, index = (report[key] for key in UP_KEYS)
    np.testing.assert_allclose(TURN @ up, UP)
    assert index == 1
    prior._dataset.kept = [2, 4, 5, 6]  # of the images on disk
    assert prior.report()[UP_KEYS[-1]] == 4


def test_a_model_whose_scale_is_unknown_has_no_poses_in_a_run_in_metres(tmp_path, monkeypatch, capfd):
    """Symptom: it kept its unit, which was called metres, also where it was the first, whose unit the map has."""
    prior, known = begun(tmp_path, "scale.height=1.5"), Metres(Scale("height", np.log(2.0), 0.03), UP, ())
    monkeypatch.setattr(module, "metres_of", lambda *given: [Metres(None, None, ("no floor",)), known])
    prior._answer = lambda frame: (np.zeros((2, 2, 3)), np.ones((2, 2)), np.ones((2, 2), bool))
    prior._depths = lambda frame: Depth(np.ones((2, 2), np.float32), None, None, 0.1)
    prior._known = drawn((NONE, 0, 1, 1))
    prior._to_metres(prior._known, ())
    assert "model 0: unknown, so no pose for its images (1); no floor" in capfd.readouterr().out
    report = prior.report()
    assert report["prior/placed_percent"] == 50 and report[UP_KEYS[-1]] == 2
    prior._up_to = lambda frame: prior._known
    predicted = prior.predict(Window(0, (0, 1, 2, 3), (2, 3), 3), (), ())
    assert np.isnan(predicted.T_anchor_view[1]).all() and np.isfinite(predicted.T_anchor_view[2:]).all()
    assert predicted.world == 0, "the map has the first world's unit"


@pytest.mark.parametrize(("doubtful", "percent"), [(["p1.png", "p3.png", "p0.png"], 50.0), ([], 0.0), (None, None)])
def test_frames_of_a_doubtful_model_are_counted(tmp_path, doubtful, percent):
    """p0 has no pose; structures of earlier versions do not say which images are doubtful."""
    about = {"key": "k", "said": []} | ({} if doubtful is None else {"doubtful": doubtful})
    (tmp_path / "structure").mkdir()
    (tmp_path / "structure" / "structure.json").write_text(json.dumps(about))
    assert begun(tmp_path).report().get("prior/doubtful_percent") == percent
    given = begun(tmp_path, "prior.structure.model=elsewhere")
    assert "prior/doubtful_percent" not in given.report()


def test_files_that_tell_scale_or_structure_count_by_their_contents(tmp_path):
    """Symptom: positions were corrected from feet to metres, and a stopped run went on in the old unit."""

    def settings(*words):
        return build(compose("prior=multiview_stereo", *words), "prior").provenance.settings

    (tmp_path / "model" / "0").mkdir(parents=True)
    mounted = "scale.T_imu_camera=[1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]"
    for name, *words in (
        ("positions.txt", f"scale.positions={tmp_path}/positions.txt"),
        ("walk.bag", f"scale.imu={tmp_path}/walk.bag:/imu", mounted),
        ("sensor.yaml", "scale.imu=imu.csv", f"scale.T_imu_camera={tmp_path}/sensor.yaml"),
        ("model/0/cameras.txt", f"prior.structure.model={tmp_path}/model"),
    ):
        (tmp_path / name).write_text("a00.jpg 3.28 0 0")
        before = settings(*words)
        assert settings(*words) == before
        (tmp_path / name).write_text("a00.jpg 1 0 0")
        assert settings(*words) != before
    assert "contents" not in settings("scale.positions=exif")


def test_a_structure_is_made_at_the_poses_of_the_data_set_if_these_are_the_positions(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(module, "structure_of", lambda *given: asked.append(given[-1]) or (drawn(), False))
    for words in ((), ("scale.positions=exif",), ("scale.positions=dataset",)):
        prior = begun(tmp_path, *words)
        prior._begin()
        is_at_poses = words == ("scale.positions=dataset",)
        assert asked.pop() is is_at_poses and (prior.provenance.settings.get("poses") == "dataset") is is_at_poses

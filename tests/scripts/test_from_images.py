"""From images alone to a map: `emgs run FOLDER`; oracle: the path of the camera that took them, up to its unit."""

import json
import sys

import cv2
import numpy as np
import pytest
from stereo_scene import room, similarity_error
from tiny_run import TINY

import experiments.run
from emgs_jax.io.trajectory import load_trajectory_tum
from emgs_jax.runs.provenance import is_metric

pytestmark = pytest.mark.xdist_group("tiny")

# As wide as the features of the simulated prior, so that the shapes are those of tiny_run.
WORDS = [word for word in TINY if not word.startswith("dataset.")]
WORDS += ["dataset.size=[64,48]", "features=random", "features.classes=[wall,floor]", "graph=none"]
WORDS += ["prior.structure.num_threads=1", "prior.dense.depth.sweep.num_planes=24"]


def test_a_folder_of_images_becomes_a_map_along_the_true_path_in_metres(tmp_path, monkeypatch):
    folder, run, places = tmp_path / "photos", tmp_path / "run", tmp_path / "places.txt"
    folder.mkdir()
    centers = {f"{frame.index:03}": frame.T_world_camera[:3, 3] for frame in room()}
    places.write_text("".join(f"{name} {' '.join(map(str, center))}\n" for name, center in centers.items()))
    for frame in room():
        cv2.imwrite(str(folder / f"{frame.index:03}.png"), cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
    monkeypatch.setattr(
        sys, "argv", ["emgs run", str(folder), *WORDS, f"scale.positions={places}", f"hydra.run.dir={run}"]
    )
    experiments.run.main()
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["frames/tracked"] == len(room()) - 1 and metrics["provenance"]["simulated"] is False
    assert "trajectory/ate_sim3_m" not in metrics and metrics["map/num_gaussians"] > 100
    poses, truth = load_trajectory_tum(run / "trajectory.txt")[1], np.stack([f.T_world_camera for f in room()])
    assert similarity_error(poses[:, :3, 3], truth[:, :3, 3]) < 0.03  # m, of a path of .56 m, at 160 pixels
    spread, true_spread = (np.linalg.norm(path[:, :3, 3].std(axis=0)) for path in (poses, truth))
    assert spread == pytest.approx(true_spread, rel=0.03) and 0 < metrics["prior/scale_std_percent"] < 5
    assert is_metric(metrics["provenance"]["prior"]["settings"])
    assert (run / "points.ply").exists() and (run / "report.html").exists()

"""Oracles: the repository's own git, strict JSON, hand-made tables."""

import json
import platform
import subprocess
from pathlib import Path

import jax
import numpy as np
import pytest

from emgs_jax.prior.base import Provenance
from emgs_jax.report.printout import metrics_table
from emgs_jax.runs.provenance import RAW_PRIOR, ROWS, git_revision, prefix_of, prefixed, provenance, write_metrics

METRICS = {
    "trajectory/ate_sim3_m": 0.0412,
    "reconstruction/accuracy_m": 0.05,
    "reconstruction/completion_m": None,
    "reconstruction/f1_20cm_percent": 98.76,
    "reconstruction/f1_5cm_percent": float("nan"),
    "reconstruction/normals_abs_cos_percent": 88.0,
}


class ADataset:
    name, sequence, calibration = "synthetic", "room-0", {"source": "rendered"}
    size, intrinsics = (40, 30), (1.0, 2.0, 3.0, 4.0)

    def fingerprint(self):
        return "abc123"


def a_provenance(is_simulated):
    prior = Provenance("simulated", {"level": 1, "seed": 7}, is_simulated)
    return provenance({"evaluation": {"protocol": "paper"}}, ADataset(), prior)


def test_provenance_names_protocol_config_data_seed_code_and_machine():
    block = a_provenance(True)
    assert (block["protocol"], block["seed"], block["simulated"]) == ("paper", 7, True)
    assert block["config"] == {"evaluation": {"protocol": "paper"}}
    cameras = {"camera": {"source": "rendered"}, "frames": {"size": [40, 30], "intrinsics": [1.0, 2.0, 3.0, 4.0]}}
    assert block["data"] == {"name": "synthetic", "sequence": "room-0", "fingerprint": "abc123"} | cameras
    assert block["prior"] == {"name": "simulated", "settings": {"level": 1, "seed": 7}}
    versions = block["versions"]
    assert set(versions) == {"python", "jax", "jaxlib", "numpy", "optimistix", "equinox", "open3d", "cv2", "emgs_jax"}
    assert (versions["jax"], versions["numpy"]) == (jax.__version__, np.__version__)
    assert versions["python"] == platform.python_version()
    assert block["device"]["backend"] == jax.default_backend()


def test_the_revision_is_that_of_git_and_none_outside_of_its_checkout(tmp_path):
    def git(*arguments):
        identity = ["-c", "user.name=t", "-c", "user.email=t@example.org"]
        command = ["git", "-C", str(tmp_path), *identity, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    try:
        git("init", "-q")
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("git is not here")
    assert git_revision(tmp_path) is None
    (tmp_path / "file").write_text("1")
    git("add", "file")
    git("commit", "-qm", "one")
    assert git_revision(tmp_path) == {"revision": git("rev-parse", "HEAD"), "dirty": False}
    (tmp_path / "file").write_text("2")
    assert git_revision(tmp_path)["dirty"] is True
    (tmp_path / "inside").mkdir()
    assert git_revision(tmp_path / "inside") is None
    assert git_revision(Path("/")) is None


def test_the_first_table_is_placed_by_points_as_the_readme_the_second_by_the_path_and_rendered():
    """The run ended with F1 by the path, and the README begins with the other one; neither said which it was."""
    placed = {"reconstruction_icp/accuracy_m": 0.04, "reconstruction_icp/f1_5cm_percent": 71.0}
    metrics = METRICS | placed | {"rendering/coverage_percent": 97.25}
    metrics |= prefixed({"reconstruction/accuracy_m": 0.05, "rendering/psnr_db": 20.0}, "baseline_tsdf_ours/")
    metrics |= {"raw_prior/trajectory/ate_sim3_m": 1.5}
    first, second = metrics_table(metrics | {"provenance": a_provenance(True)}).split("\n\n")
    assert first.split()[:3] == ["simulated", "ATE", "[cm]"] and second.startswith("simulated") and "TSDF" not in first
    assert first.splitlines()[3].split()[:4] == ["raw", "prior", "150.00", "–"]
    alone = metrics_table(METRICS | {"provenance": a_provenance(False)})
    assert "simulated" not in alone and "raw prior" not in alone
    _, _, ours, tsdf = second.splitlines()
    assert "ICP: F1@.05 [%]" in first and "path: F1@.05 [%]" in second
    assert "F1" not in first.replace("ICP: F1", "") and "F1" not in second.replace("path: F1", "")
    assert first.splitlines()[2].split() == ["ours", "4.12", "4.00", "–", "–", "71.0", "–"]
    assert ours.split() == ["ours", "5.00", "–", "98.8", "–", "88.0", "97.2", *["–"] * 4]
    assert tsdf.split() == ["TSDF,", "our", "poses", "5.00", *["–"] * 8, "20.0"]


def test_metrics_are_strict_json_ours_first_then_the_raw_prior_then_provenance(tmp_path):
    kinds = {f"{prefix}rendering/psnr_db": 1.0 for prefix in reversed(list(ROWS))}
    metrics = {"provenance": a_provenance(True)} | prefixed(METRICS, RAW_PRIOR) | {"time/seconds_per_frame": 0.5}
    metrics |= METRICS | kinds
    write_metrics(tmp_path / "metrics.json", metrics)

    loaded = json.loads((tmp_path / "metrics.json").read_text(), parse_constant=pytest.fail)
    order = [prefix_of(key) for key in loaded]
    assert list(loaded)[-1] == "provenance" and list(dict.fromkeys(order[:-1])) == list(ROWS)
    assert [key for key in loaded if key in METRICS] == list(METRICS)
    assert loaded["reconstruction/f1_5cm_percent"] is None
    assert loaded["raw_prior/trajectory/ate_sim3_m"] == 0.0412
    assert loaded["provenance"] == metrics["provenance"]

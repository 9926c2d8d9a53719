"""Oracles: poses that come back, and broken files."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from emgs_jax.io.trajectory import load_trajectory_tum, save_trajectory_tum


def test_a_trajectory_comes_back_with_unit_quaternions_in_tum_order(tmp_path):
    rng = np.random.default_rng(6)
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = Rotation.random(9, rng).as_matrix(), rng.normal(size=(9, 3))
    stamps = 1305031098.6659 + np.arange(9) / 30
    save_trajectory_tum(tmp_path / "trajectory.txt", stamps, poses)
    times, loaded = load_trajectory_tum(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(times, stamps, rtol=0, atol=1e-6)
    np.testing.assert_allclose(loaded, poses, atol=5e-9)
    rows = np.loadtxt(tmp_path / "trajectory.txt")
    assert (rows[:, 7] >= 0).all() and (Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, 3] < 0).any()
    quarter = np.eye(4)
    quarter[:3, :3], quarter[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [1, 2, 3]
    save_trajectory_tum(tmp_path / "trajectory.txt", [0.5], quarter[None])
    row = [float(field) for field in (tmp_path / "trajectory.txt").read_text().splitlines()[1].split()]
    np.testing.assert_allclose(row, [0.5, 1, 2, 3, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-9)
    save_trajectory_tum(tmp_path / "trajectory.txt", [], np.empty((0, 4, 4)))
    assert load_trajectory_tum(tmp_path / "trajectory.txt")[1].shape == (0, 4, 4)


BROKEN = ("1 2 3", "1 0 0 0 0 0 0 0", "1 a 0 0 0 0 0 1", "1 nan 0 0 0 0 0 1", "\x00\xff", "1 0 0 0 0 0 0 1e200")
BROKEN += ("1 1e300 0 0 0 0 0 1", "1 0 0 0 0 0 0 2")


@pytest.mark.parametrize("line", BROKEN)
def test_a_broken_trajectory_names_file_and_line(tmp_path, line):
    (tmp_path / "t.txt").write_text("# comment\n0 0 0 0 0 0 0 1\n" + line + "\n", encoding="latin-1")
    with pytest.raises(ValueError, match=r"t\.txt:3: expected"):
        load_trajectory_tum(tmp_path / "t.txt")
    with pytest.raises(ValueError, match="finite"):
        save_trajectory_tum(tmp_path / "t.txt", [0.0], np.full((1, 4, 4), np.nan))

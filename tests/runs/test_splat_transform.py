"""map.ply in another program: what splat-transform of PlayCanvas, the makers of SuperSplat, finds in it."""

import csv
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from emgs_jax.io.ply import save_gaussians_ply
from emgs_jax.io.ply_reader import read_vertices

TOOL = shutil.which("splat-transform")
pytestmark = pytest.mark.skipif(TOOL is None, reason="no splat-transform (npm install -g @playcanvas/splat-transform)")


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    """Fifty Gaussians that differ in everything."""
    path, rng = tmp_path_factory.mktemp("map") / "map.ply", np.random.default_rng(0)
    roots = rng.normal(0.0, 0.1, (50, 3, 3))
    normals = rng.normal(size=(50, 3))
    means, covs, colors = rng.normal(0.0, 3.0, (50, 3)), roots @ roots.swapaxes(1, 2), rng.uniform(size=(50, 3))
    assert save_gaussians_ply(path, means, covs, colors, rng.uniform(0.1, 0.9, 50), normals) == 50
    return path


def transform(*words: str | Path) -> str:
    done = subprocess.run([str(TOOL), *map(str, words)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_number_that_it_reads_is_the_one_that_was_written(path):
    target = path.with_suffix(".csv")
    transform("-w", path, target)
    titles, *lines = csv.reader(target.read_text().splitlines())
    rows, ours = np.array(lines, np.float64), read_vertices(path)
    assert {*titles} == {*ours} and len(rows) == 50
    for name, column in zip(titles, rows.T, strict=True):
        np.testing.assert_array_equal(column.astype(np.float32), ours[name], err_msg=name)

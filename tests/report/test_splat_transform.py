"""map.ply in another program: what splat-transform of PlayCanvas, the makers of SuperSplat, finds in it."""

import csv
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.special import expit

from emgs_jax.io.ply import save_gaussians_ply
from emgs_jax.io.ply_reader import read_vertices

TOOL = shutil.which("splat-transform")
SH_C0 = 0.5 / np.sqrt(np.pi)  # zeroth spherical harmonic
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


def test_its_summary_agrees_with_ours_column_by_column(path):
    """It shows colours for harmonics, opacities for logits and lengths for logarithms, in six digits."""
    asked = ["--stats", "text"] if "--stats" in transform("--help") else ["-m"]  # of version 3, of 2
    said, ours = transform(path, *asked, "null"), read_vertices(path)
    assert re.search(r"(gaussians:|Row Count:\*\*) 50\n", said)
    table = [[cell.strip() for cell in line.split("|")[1:-1]] for line in said.splitlines() if line.startswith("|")]
    titles, lines = table[0], {line[0]: dict(zip(table[0], line, strict=True)) for line in table[2:]}
    assert titles[1:3] == ["min", "max"] and {*lines} == {*ours}
    for name, values in ours.items():
        shows = {"f": lambda v: 0.5 + SH_C0 * v, "o": expit, "s": np.exp}.get(name[0], lambda v: v)
        values, line = values.astype(np.float64), lines[name]
        expected = [shows(value) for value in (values.min(), values.max(), values.mean())]
        found = [float(line[title]) for title in ("min", "max", "mean")]
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=2e-6, err_msg=name)
        assert (line["nans"], line["infs"]) == ("0", "0")


def test_every_number_that_it_reads_is_the_one_that_was_written(path):
    target = path.with_suffix(".csv")
    transform("-w", path, target)
    titles, *lines = csv.reader(target.read_text().splitlines())
    rows, ours = np.array(lines, np.float64), read_vertices(path)
    assert {*titles} == {*ours} and len(rows) == 50
    for name, column in zip(titles, rows.T, strict=True):
        np.testing.assert_array_equal(column.astype(np.float32), ours[name], err_msg=name)

"""Several settings in one process, and a search by the page's own words; oracles: JAX's log, what the runs say."""

import os
import re
import subprocess
import sys

import pytest
from tiny_run import CONF, TINY

from emgs_jax.report.multirun import read_multirun

ATE = "trajectory/ate_sim3_m"
NOISE = "slam.em.noise"


@pytest.mark.slow
def test_values_of_a_traced_key_share_one_compilation(tmp_path):
    given = ["slam.em.noise=0,1", *TINY, "dataset.stop=4", f"hydra.sweep.dir={tmp_path}"]
    environment = os.environ | {"JAX_LOG_COMPILES": "1"}
    done = subprocess.run(
        [sys.executable, "-m", "experiments.run", "-m", *given],
        cwd=CONF.parent,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    compiled = re.findall(r"^(?:.* )?Compiling (?:jit\()?(\w+)", done.stderr, re.MULTILINE)
    for stage in ("_localize_coarse", "_select", "_localize_fine", "_fuse", "refine", "_store"):
        assert compiled.count(stage) == 1, stage
    keys, rows = read_multirun(tmp_path)
    assert keys == [NOISE] and [row[NOISE] for row in rows] == ["0", "1"]
    assert rows[0][ATE] != rows[1][ATE]


@pytest.mark.weekly
def test_the_search_of_the_page_finds_what_its_trials_say_and_goes_on(tmp_path, monkeypatch, capsys):
    """The code of docs/experiments.md as it stands there, of two trials on a small sequence."""
    optuna = pytest.importorskip("optuna")
    page = (CONF.parent / "docs" / "experiments.md").read_text()
    (code,) = re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    words = repr([*TINY, "dataset.stop=4"])
    smaller = {'["experiment=smoke"]': words, "NUM_TRIALS = 48": "NUM_TRIALS = 2", "(0, 1), (3,)": "(0,), (3,)"}
    for old, new in smaller.items():
        assert code.count(old) == 1
        code = code.replace(old, new)
    monkeypatch.chdir(tmp_path)
    for _ in range(2):  # the second time nothing is left to try
        variables: dict = {"__name__": "__main__"}
        exec(compile(code, "experiments.md", "exec"), variables)
        study = variables["study"]
        assert len(study.trials) == 2 and all(trial.state == optuna.trial.TrialState.COMPLETE for trial in study.trials)
    said = capsys.readouterr().out
    assert said.count("default [") == 2 and all(str(trial.params) in said for trial in study.best_trials)

"""Prior and mapping may live in different environments: recording needs no JAX, mapping a recording no PyTorch."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from tiny_run import TINY

from emgs_jax.prior.recorded import Recorded

ROOT = Path(__file__).resolve().parents[2]


def python(program: str, *arguments: object, path: Path = ROOT) -> str:
    """Run a program in a new process and return what it prints."""
    search = os.pathsep.join([str(path), str(ROOT)])
    command = [sys.executable, "-c", program, *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": search}
    answer = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, check=False)
    assert answer.returncode == 0, answer.stderr
    return answer.stdout


WITHOUT_JAX = """
import runpy, sys
for name in ("jax", "jaxlib", "equinox", "optimistix", "jaxlie"):
    sys.modules[name] = None  # an import of it fails
script, sys.argv = sys.argv[1], sys.argv[1:]
runpy.run_module(script, run_name="__main__")
"""


@pytest.mark.slow
def test_recording_and_embedding_need_no_jax(tmp_path):
    features = ("features=random", "features.classes=[wall,floor]")
    python(WITHOUT_JAX, "experiments.predict", *TINY, *features, f"out={tmp_path / 'live'}")
    recording = Recorded(tmp_path / "live")
    assert recording.provenance.name == "simulated+random" and recording.feature_names == ("wall", "floor")
    # A recording of a recording: the same with a prior that is neither simulated nor a network.
    replay = ("prior=recorded", f"prior.folder={tmp_path / 'live'}", f"out={tmp_path / 'again'}")
    python(WITHOUT_JAX, "experiments.predict", *TINY, *replay)
    for path in (tmp_path / "live").iterdir():
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes(), path.name
    python(WITHOUT_JAX, "experiments.embed", "features=random", "classes=[lamp]", f"out={tmp_path / 'text.npz'}")
    assert (tmp_path / "text.npz").exists()


MAPPING = """
import sys
import hydra
from experiments import run  # everything that a run imports
from emgs_jax.running.configure import build_dataset, build_prior, compose
from emgs_jax.running.record import new_run
from emgs_jax.running.inputs import predictions
from emgs_jax.running.convert import to_first_window
import numpy as np

config = compose(*sys.argv[1:])
dataset = build_dataset(config)
prior = build_prior(config, dataset)
session = new_run(dataset, hydra.utils.instantiate(config.slam))
steps = predictions(dataset, prior, session.config.window_size, session.clock)
window, _ = to_first_window(*next(steps), np.eye(4), session.config.observation)
print("features", window.views.features.shape[-1], "inferences", 1 + len(list(steps)))
print([name for name in sys.modules if name.split(".")[0] in ("torch", "transformers")])
"""


@pytest.mark.slow
def test_mapping_a_recording_imports_no_pytorch(tmp_path):
    """Packages of these names that can be imported stand in the way, so that an import would be seen anywhere."""
    for name in ("torch", "transformers"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").touch()
    program = "import runpy, sys; sys.argv = sys.argv[1:]; runpy.run_module(sys.argv[0], run_name='__main__')"
    python(program, "experiments.predict", *TINY, "features=random", f"out={tmp_path / 'recording'}")
    text = ("experiments.embed", "features=random", "classes=[lamp]", f"out={tmp_path / 'text.npz'}")
    python(program, *text)
    replay = ("prior=recorded", f"prior.folder={tmp_path / 'recording'}", f"features.text={tmp_path / 'text.npz'}")
    said = python(MAPPING, *TINY, *replay, path=tmp_path)
    assert said.splitlines() == ["features 16 inferences 4", "[]"]

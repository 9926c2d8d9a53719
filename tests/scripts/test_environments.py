"""Prior and mapping may live in different environments: recording needs no JAX, mapping a recording no PyTorch."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from tiny_run import TINY

from emgs_jax.features.text import read_text
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
words, begin = sys.argv[1:], 0
while begin < len(words):  # commands, each with its words, one after the other
    end = words.index("then", begin)
    sys.argv = words[begin:end]
    runpy.run_module(sys.argv[0], run_name="__main__")
    begin = end + 1
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """What three commands write without JAX: a recording, a recording of that, and embeddings."""
    folder = tmp_path_factory.mktemp("recorded")
    replay = ("prior=recorded", f"prior.folder={folder / 'live'}", f"out={folder / 'again'}")
    # Keys of stages are those of their classes, which need JAX.
    of_data = [word for word in TINY if word.startswith(("dataset.", "slam.window_size"))]
    words = (
        "experiments.predict",
        *of_data,
        "features=random",
        "features.classes=[wall,floor]",
        f"out={folder / 'live'}",
    )
    # A recording of a recording: the same with a prior that is neither simulated nor a network.
    again = "experiments.predict", *of_data, *replay
    text = "experiments.embed", "features=random", "classes=[lamp]", f"out={folder / 'text.npz'}"
    python(WITHOUT_JAX, *words, "then", *again, "then", *text, "then")
    return folder


@pytest.mark.slow
def test_recording_and_embedding_need_no_jax(recorded):
    recording = Recorded(recorded / "live")
    assert recording.provenance.name == "simulated+random" and recording.feature_names == ("wall", "floor")
    for path in (recorded / "live").iterdir():
        assert path.read_bytes() == (recorded / "again" / path.name).read_bytes(), path.name
    assert read_text(recorded / "text.npz").names == ("lamp",)


MAPPING = """
import sys
import hydra
from experiments import run  # everything that a run imports
from emgs_jax.config.configure import build_dataset, build_prior, compose
from emgs_jax.mapping.run import new_run
from emgs_jax.mapping.window_input import predictions
from emgs_jax.mapping.convert import to_first_window
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
def test_mapping_a_recording_imports_no_pytorch(recorded, tmp_path):
    """Packages of these names that can be imported stand in the way, so that an import would be seen anywhere."""
    for name in ("torch", "transformers"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").touch()
    replay = ("prior=recorded", f"prior.folder={recorded / 'live'}", f"features.text={recorded / 'text.npz'}")
    said = python(MAPPING, *TINY, *replay, path=tmp_path)
    assert said.splitlines() == ["features 16 inferences 4", "[]"]

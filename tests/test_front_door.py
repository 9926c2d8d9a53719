"""What a user meets first: names at the top, one call from words to a map, and an import that changes nothing."""

import os
import subprocess
import sys
from pathlib import Path

import hydra
import numpy as np
import pytest
from hydra.core.global_hydra import GlobalHydra
from scene import same_bits
from tiny_run import NUM_FRAMES, TINY, dataset

import emgs_jax
from emgs_jax.config.configure import CONF, groups
from emgs_jax.config.configure import compose as compose_as_typed
from emgs_jax.gaussian_map import GaussianMap

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("tiny")]

PACKAGE = Path(emgs_jax.__file__).parent
NO_MARK = """
import sys
import jax
before = dict(jax.config.values)
import emgs_jax
dir(emgs_jax), emgs_jax.__version__
heavy = {"matplotlib", "open3d", "torch", "trimesh", "cv2", "scipy", "hydra", "equinox", "optimistix"}
print(sorted(heavy & set(sys.modules)))
emgs_jax.step, emgs_jax.map_sequence, emgs_jax.load_map
print({name for name, value in jax.config.values.items() if before.get(name, value) != value} or "unchanged")
print(sorted({"matplotlib", "open3d", "torch"} & set(sys.modules)))
"""


def python(program: str, **environment: str) -> str:
    command, variables = [sys.executable, "-c", program], os.environ | {"PYTHONPATH": str(PACKAGE.parent)} | environment
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=variables)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_loads_nothing_else_and_changes_no_setting_of_jax():
    assert python(NO_MARK).splitlines() == ["[]", "unchanged", "[]"]


def test_importing_keeps_jax_quiet_unless_the_user_says_otherwise():
    """300 lines about executables from the cache that are sound; jaxlib reads the level as it is loaded."""
    said = 'import emgs_jax, os; print(os.environ["TF_CPP_MIN_LOG_LEVEL"])'
    assert python(said, TF_CPP_MIN_LOG_LEVEL="0").split() == ["0"]
    without = "import os; os.environ.pop('TF_CPP_MIN_LOG_LEVEL', None); "
    assert python(without + said).split() == ["3"] == python(without + "import experiments, os; " + said).split()


def test_every_name_is_there_and_no_other_and_none_is_hidden_by_a_folder_of_the_package():
    for name in emgs_jax.__all__:
        assert getattr(emgs_jax, name) is not None
    listed = {name for name in dir(emgs_jax) if not name.startswith("__")}
    assert listed == {*emgs_jax.__all__} - {"__version__"} and len({*emgs_jax.__all__}) == len(emgs_jax.__all__)
    inside = {path.stem for path in PACKAGE.iterdir()} | {"conf", "experiments"}
    assert not inside & set(emgs_jax.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        emgs_jax.nothing  # noqa: B018


@pytest.mark.parametrize("name", [name for name in groups()["dataset"] if name != "camera"])  # it has no stop
def test_a_preset_sets_keys_of_a_data_set_and_adds_none(name):
    """`experiment=smoke` gave every data set a key of the built-in room, which the others refuse."""
    own = set(compose_as_typed(f"dataset={name}").dataset)
    for experiment in groups()["experiment"]:
        assert set(compose_as_typed(f"dataset={name}", f"experiment={experiment}").dataset) == own


@pytest.mark.parametrize("experiment", groups()["experiment"])
def test_every_preset_becomes_a_config(experiment):
    config = emgs_jax.load_config(f"experiment={experiment}")
    assert isinstance(config.slam, emgs_jax.SlamConfig) and isinstance(config.densify, emgs_jax.DensifyConfig)
    assert config.settings["slam"]["window_size"] == config.slam.window_size
    assert config.settings["evaluation"]["protocol"] == config.evaluation.protocol


def test_a_config_holds_what_the_command_line_gives():
    config = emgs_jax.load_config(*TINY, "slam.em.noise=0.5")
    assert config.settings["slam"]["em"]["noise"] == 0.5 and float(config.slam.em.noise) == 0.5
    assert config.settings["slam"]["em"]["min_std"] == config.settings["slam"]["fit"]["min_std"], "resolved"
    assert config.evaluation.protocol == "paper/sim3"


@pytest.mark.slow
def test_the_snippet_of_the_documentation_maps_a_sequence_in_two_ways_with_the_same_bits(tmp_path, monkeypatch, capsys):
    """Oracles: the truth, since the prior is exact; one way for the other."""
    monkeypatch.chdir(tmp_path)
    text = (PACKAGE.parent / "docs" / "how_it_works.md").read_text(encoding="utf-8")
    (snippet,) = [part.split("```")[0] for part in text.split("```python\n")[1:] if "map_sequence" in part]
    tiny = ", ".join(repr(word) for word in (*TINY, "prior.level=0", "compilation_cache=off"))
    assert snippet.count('"dataset=synthetic", "experiment=smoke"') == 2
    found: dict = {}
    exec(snippet.replace('"dataset=synthetic", "experiment=smoke"', tiny), found)
    assert "mapping: 100%" in capsys.readouterr().err
    run = found["run"]
    assert isinstance(found["map"], GaussianMap) and same_bits(found["map"], run.map)  # saved and loaded
    assert same_bits(found["state"], run.state)
    truth = np.stack([dataset()[row].T_world_camera for row in range(NUM_FRAMES)])
    np.testing.assert_allclose(run.poses, truth, atol=1e-3)
    np.testing.assert_allclose(run.raw_poses, truth, atol=1e-12)
    assert [record.status for record in run.records] == ["initialization"] + ["tracked"] * (NUM_FRAMES - 1)
    assert int(found["info"].num_gaussians) == run.records[-1].num_gaussians


def test_settings_survive_a_hydra_program_around_them():
    """Composing inside of one of Hydra's programs leaves its state as it is."""
    with hydra.initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        compose_as_typed()
        assert GlobalHydra.instance().is_initialized()
        assert hydra.compose("config").slam.window_size == 10
    assert not GlobalHydra.instance().is_initialized()

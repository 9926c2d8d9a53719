"""What a user meets first: names at the top, one call from words to a map, and an import that changes nothing."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from tiny_run import NUM_FRAMES, TINY, EditedPrior, compose, dataset

import emgs_jax
from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.running.configure import groups
from emgs_jax.running.inputs import inputs

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


def test_every_name_is_there_and_none_is_hidden_by_a_folder_of_the_package():
    for name in emgs_jax.__all__:
        assert getattr(emgs_jax, name) is not None
    assert set(emgs_jax.__all__) <= set(dir(emgs_jax)) and len(set(emgs_jax.__all__)) == len(emgs_jax.__all__)
    inside = {path.stem for path in PACKAGE.iterdir()} | {"conf", "experiments"}
    assert not inside & set(emgs_jax.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        emgs_jax.nothing  # noqa: B018


def test_editors_see_the_names_that_run():
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    seen = {(alias.asname or alias.name): node.module for node in block.body for alias in node.names}
    assert seen == {name: f"emgs_jax.{home}" for name, home in emgs_jax._HOME_OF.items()}


@pytest.mark.parametrize("name", groups()["dataset"])
@pytest.mark.parametrize("experiment", [None, *groups()["experiment"]])
def test_every_data_set_composes_with_every_preset(name, experiment):
    """`experiment=smoke` gave every data set a key of the built-in room, which the others refuse."""
    config = emgs_jax.load_config(f"dataset={name}", *([f"experiment={experiment}"] if experiment else []))
    assert isinstance(config.slam, emgs_jax.SlamConfig) and isinstance(config.densify, emgs_jax.DensifyConfig)
    given = set(config.settings["dataset"]) - {"_target_"}
    written = emgs_jax.load_config(f"dataset={name}").settings["dataset"]
    assert given == set(written) - {"_target_"}, "a preset may set keys of a data set, but not add any"


def test_a_config_holds_what_the_command_line_gives():
    config = emgs_jax.load_config(*TINY, "slam.em.noise=0.5")
    assert config.settings["slam"]["em"]["noise"] == 0.5 and float(config.slam.em.noise) == 0.5
    assert config.settings["slam"]["em"]["min_std"] == config.settings["slam"]["fit"]["min_std"], "resolved"
    assert config.evaluation.protocol == "paper/sim3"


@pytest.mark.slow
def test_a_sequence_becomes_a_map_that_is_saved_loaded_and_carried_on_by_ones_own_loop(tmp_path, capsys):
    """Oracle: the truth, since the prior is exact; and the run itself for the loop."""
    config = emgs_jax.load_config(*TINY, "prior.level=0", "compilation_cache=off")
    run = emgs_jax.map_sequence(config)
    assert "mapping: 100%" in capsys.readouterr().err
    truth = np.stack([dataset()[row].T_world_camera for row in range(NUM_FRAMES)])
    np.testing.assert_allclose(run.poses, truth, atol=1e-3)
    np.testing.assert_allclose(run.raw_poses, truth, atol=1e-12)
    assert [record.status for record in run.records] == ["initialization"] + ["tracked"] * (NUM_FRAMES - 1)

    emgs_jax.save_map(tmp_path / "map.npz", run.map)
    loaded = emgs_jax.load_map(tmp_path / "map.npz")
    assert isinstance(loaded, GaussianMap) and same_bits(loaded, run.map)

    first, *rest = inputs(dataset(), EditedPrior(), config.slam, emgs_jax.new_run(dataset(), config.slam).clock)
    camera = emgs_jax.to_camera(dataset())
    state, _ = emgs_jax.init_state(first.taken.views, first.taken.T_world_views, camera, config.slam)
    for given in rest:
        state, info = emgs_jax.step(state, given.taken, camera, config.slam)
    state = emgs_jax.own_unit(state, first.T_world_anchor[:3, 3])
    assert int(info.num_gaussians) == run.records[-1].num_gaussians and same_bits(state, run.state)


@pytest.mark.slow
def test_the_snippet_of_the_readme_runs_and_both_ways_give_the_same_map(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (PACKAGE.parent / "README.md").read_text(encoding="utf-8")
    (snippet,) = [part.split("```")[0] for part in text.split("```python\n")[1:] if "map_sequence" in part]
    tiny = ", ".join(repr(word) for word in (*TINY, "compilation_cache=off"))
    assert snippet.count('"dataset=synthetic", "experiment=smoke"') == 2
    found: dict = {}
    exec(snippet.replace('"dataset=synthetic", "experiment=smoke"', tiny), found)
    assert same_bits(found["map"], found["run"].map) and same_bits(found["state"], found["run"].state)


def same_bits(tree, other) -> bool:
    pairs = zip(jax.tree.leaves(tree), jax.tree.leaves(other), strict=True)
    return all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in pairs)


def test_settings_survive_a_hydra_program_around_them():
    """Composing inside of one of Hydra's programs leaves its state as it is."""
    import hydra
    from hydra.core.global_hydra import GlobalHydra

    from emgs_jax.running.configure import CONF

    with hydra.initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        compose()
        assert GlobalHydra.instance().is_initialized()
        assert hydra.compose("config").slam.window_size == 10
    assert not GlobalHydra.instance().is_initialized()

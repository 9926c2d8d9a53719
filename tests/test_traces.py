"""Changing a number of the config compiles nothing: one trace of the step for every value of every traced leaf."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from scene import observe_room, path_pose, predict_room, slam_config, stack_poses

from emgs_jax.ops.pytree import stack
from emgs_jax.slam import init_state, step

traces = []
pytestmark = pytest.mark.slow  # one compilation of the whole step is half a minute


@eqx.filter_jit
def counted_step(state, prediction, camera, config):
    traces.append(1)  # runs while tracing only
    return step(state, prediction, camera, config)


def leaves(config):
    return [(jax.tree_util.keystr(path), leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(config)]


def choices(module, prefix=""):
    """Dotted paths of the traced choice fields of a config and their number of names."""
    found = {}
    for name, field in module.__dataclass_fields__.items():
        value, path = getattr(module, name), f"{prefix}.{name}"
        if isinstance(value, eqx.Module):
            found |= choices(value, path)
        elif "choices" in field.metadata and not field.metadata.get("static"):
            found[path] = len(field.metadata["choices"])
    return found


@pytest.fixture(scope="module")
def started(camera):
    """State, prediction and camera of a first step."""
    poses = [path_pose(i) for i in range(3)]
    views = stack([observe_room(T, camera, num_features=2) for T in poses])
    state, _ = init_state(views, stack_poses(poses), camera, slam_config("slam.initialization=merged"))
    return state, predict_room(3, camera, num_features=2), camera


@pytest.fixture(scope="module")
def compiled(started):
    """The step, compiled once, as a function of the config."""
    call = lambda config: jax.block_until_ready(counted_step(*started, config))  # noqa: E731
    call(slam_config("slam.initialization=merged"))
    return call


def test_every_matrix_product_of_a_step_is_in_full_float32(started):
    """By default JAX lets a GPU round the factors to ten bits, which no test on a CPU would notice."""
    lowered = jax.jit(step).lower(*started, slam_config("slam.initialization=merged")).as_text()
    products = [line for line in lowered.splitlines() if "stablehlo.dot_general" in line]
    assert products and all("precision = [HIGHEST, HIGHEST]" in line for line in products)


def test_ten_thresholds_from_yaml_are_one_trace(compiled):
    before = len(traces)
    for value in ("1", "2.5", "3.0", "4", "5.5", "6", "7.25", "8", "9.0", ".inf"):
        compiled(
            slam_config("slam.initialization=merged", f"slam.em.max_mahalanobis_sq={value.replace('.inf', 'inf')}")
        )
    assert len(traces) == before


def test_changing_any_traced_number_traces_nothing(compiled):
    config, before = slam_config("slam.initialization=merged"), len(traces)
    values, structure = jax.tree.flatten(config)
    assert len(values) > 40
    for i, (path, leaf) in enumerate(leaves(config)):
        changed = jax.tree.unflatten(
            structure, [*values[:i], jnp.where(jnp.isfinite(leaf), leaf * 1.1, 1.0), *values[i + 1 :]]
        )
        compiled(changed)
        assert len(traces) == before, path


def test_changing_any_reading_traces_nothing(compiled):
    config, before = slam_config("slam.initialization=merged"), len(traces)
    found = choices(config)
    assert {".localization.coarse", ".em.support", ".localization.icp.residual", ".em.average.gain"} <= set(found)
    names, (values, structure) = [path for path, _ in leaves(config)], jax.tree.flatten(config)
    for path, count in found.items():
        i = names.index(path)
        for reading in range(count):
            compiled(jax.tree.unflatten(structure, [*values[:i], jnp.asarray(reading, jnp.float32), *values[i + 1 :]]))
            assert len(traces) == before, (path, reading)


def test_the_presets_paper_and_default_are_one_trace(compiled):
    paper = ("slam/em=paper", "slam/localization=paper", "slam/refinement=paper", "slam.initialization=merged")
    before = len(traces)
    compiled(slam_config(*paper))
    assert len(traces) == before

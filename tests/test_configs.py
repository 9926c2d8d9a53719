"""Every YAML composes, every key is a parameter of its class, and every field of a config class is read somewhere."""

import ast
import dataclasses
import inspect
import re
import typing
from pathlib import Path

import hydra
import pytest
from omegaconf import OmegaConf
from scene import CONF, compose, slam_config

from emgs_jax.running import configure
from emgs_jax.slam import SlamConfig

ROOT = CONF.parent
# Studies and suites hold no class; tests/scripts composes them.
UNTYPED = {CONF, CONF / "experiment", CONF / "experiment_on", CONF / "suite", CONF / "sweep", CONF / "tune"}
GATE = CONF / "baseline" / "smoke.yaml"  # results to compare with, no option
OF_COMMANDS = {"protocol": "segment"}  # groups of another command than a run
GROUPED = sorted(path for path in CONF.rglob("*.yaml") if path.parent not in UNTYPED and path != GATE)


def group_and_option(path: Path) -> tuple[str, str]:
    return str(path.parent.relative_to(CONF)), path.stem


def composed(group: str, option: str) -> dict:
    """The config of the command that has the group."""
    if group not in OF_COMMANDS:
        return OmegaConf.to_container(compose(f"{group}={option}"), resolve=False)
    config = configure.compose(f"{group}={option}", name=OF_COMMANDS[group])
    return {group: OmegaConf.to_container(config[group], resolve=False)}


def targets(node):
    """All nodes of a composed config that name a class."""
    if isinstance(node, dict):
        if "_target_" in node:
            yield node
        for value in node.values():
            yield from targets(value)


@pytest.mark.parametrize("path", GROUPED, ids=lambda path: "/".join(group_and_option(path)))
def test_every_option_composes_and_its_keys_are_parameters(path):
    group, option = group_and_option(path)
    nodes = list(targets(composed(group, option)))
    assert nodes
    for node in nodes:
        parameters = inspect.signature(hydra.utils.get_class(node["_target_"])).parameters
        keys = {key for key in node if not key.startswith("_")}
        assert keys <= set(parameters), f"{node['_target_']}: {keys - set(parameters)}"
        required = {
            n for n, p in parameters.items() if p.default is p.empty and p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)
        }
        assert required <= keys, f"{node['_target_']}: {required - keys} have no value"


@pytest.mark.parametrize(
    "path", [p for p in GROUPED if "slam" in p.parts], ids=lambda path: "/".join(group_and_option(path))
)
def test_every_option_of_slam_instantiates(path):
    group, option = group_and_option(path)
    assert isinstance(slam_config(f"{group}={option}"), SlamConfig)


def test_an_unknown_key_is_refused():
    with pytest.raises(hydra.errors.ConfigCompositionException):
        compose("slam.em.max_mahalanobis=3")
    with pytest.raises(hydra.errors.InstantiationException, match="max_mahalanobis"):
        slam_config("+slam.em.max_mahalanobis=3")


def test_table_i_is_the_paper_preset():
    groups = ("observation", "fit", "localization", "em", "refinement")
    config = hydra.utils.instantiate(compose(*(f"slam/{g}=paper" for g in groups)).slam, _convert_="all")
    em, refinement = config.em, config.refinement
    assert (config.window_size, config.fit.points_per_gaussian, config.observation.thin) == (10, 128, 1)
    assert (em.num_neighbours, refinement.num_candidates) == (16, 3)
    assert (em.min_normal_cos, em.normal_weight, em.feature_weight) == (0.5, 5, 5)
    assert float(em.max_mahalanobis_sq) == pytest.approx(4.6)
    assert float(refinement.max_mahalanobis_sq_2d) == pytest.approx(4.6)


def test_the_paper_preset_takes_every_printed_reading():
    """The column *printed* of docs/readings.md."""
    paper = compose(*(f"slam/{g}=paper" for g in ("observation", "fit", "localization", "em", "refinement")))
    printed = {
        "em.determinant_weight": 1.0,  # R2
        "em.max_log_gap": float("inf"),  # R3
        "em.average.gain": "ema_printed",  # R4
        "em.average.forgetting": 1.0,
        "em.average.max_weight": float("inf"),
        "em.support": "printed",  # R5
        "refinement.front_margin": 0.0,  # R6
        "localization.coarse": "via_previous",  # R7
        "localization.coarse_scale": "none",  # R8
        "localization.icp.residual": "colored",  # R9
        "localization.icp.prior_information": 0.0,
        "em.average.blend": "linear",  # R13
        "fit.feature": "medoid",  # R16
        "em.noise": 0.0,
    }
    assert {key: OmegaConf.select(paper.slam, key) for key in printed} == printed


def config_classes():
    """Every class of conf/ that holds settings only, and the config classes that they hold."""
    seen = set()

    def visit(module):
        if module in seen or not dataclasses.is_dataclass(module):
            return
        seen.add(module)
        for hint in typing.get_type_hints(module).values():
            if inspect.isclass(hint):
                visit(hint)

    for group, option in map(group_and_option, GROUPED):
        for node in targets(composed(group, option)):
            visit(hydra.utils.get_class(node["_target_"]))
    return seen


def test_every_field_of_a_config_class_is_read():
    read = set()
    for folder in ("emgs_jax", "experiments"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
                    read.add(node.attr)
    classes = config_classes()
    names = {module.__name__ for module in classes}
    assert {"SlamConfig", "IcpConfig", "DensifyConfig", "EvaluationConfig", "MaskConfig", "SweepConfig"} <= names
    unread = [f"{module.__name__}.{field.name}" for module in classes for field in dataclasses.fields(module)]
    assert not [name for name in unread if name.rpartition(".")[2] not in read]


def test_every_number_of_a_config_class_declares_its_range():
    """A threshold that takes any value takes nan; `emgs_jax.running.values` refuses what is out of range."""
    numeric = re.compile(r"\bint\b|\bfloat\b|Float\[")
    without = [
        f"{module.__name__}.{field.name}"
        for module in config_classes()
        for field in dataclasses.fields(module)
        if numeric.search(str(field.type)) and not {"range", "choices"} & field.metadata.keys()
    ]
    assert sorted(without) == ["ImageConfig.mean", "ImageConfig.std"], "colours: any finite number"


def test_a_value_that_stands_in_a_constructor_too_is_the_same_there():
    """conf/ is where a value is looked up; a class that can be made by hand must not disagree with it."""
    for group, option in map(group_and_option, GROUPED):
        if option not in ("default", "paper", "none", group):
            for node in targets(composed(group, option)):
                if node["_target_"].startswith(("emgs_jax.data.", "emgs_jax.prior.")):
                    parameters = inspect.signature(hydra.utils.get_class(node["_target_"])).parameters
                    for key, value in node.items():
                        if key in parameters and parameters[key].default is not inspect.Parameter.empty:
                            default = parameters[key].default
                            assert (list(default) if isinstance(default, tuple) else default) == value, key

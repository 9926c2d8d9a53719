"""Every YAML composes, every key is a parameter of its class, and every field of a config class is read somewhere."""

import ast
import dataclasses
import inspect
import math
import re
import typing
from functools import cache
from pathlib import Path

import hydra
from omegaconf import OmegaConf
from scene import CONF, compose, slam_config

from emgs_jax.config import configure
from emgs_jax.slam import SlamConfig

ROOT = CONF.parent
# Studies and suites hold no class; tests/scripts composes them.
UNTYPED = {CONF} | {CONF / name for name in ("densify_on", "experiment", "experiment_on", "suite")}
OF_COMMANDS = {"protocol": "segment"}  # groups of another command than a run
OF_PRIORS = {"prior/dense": "prior=multiview_stereo"}  # groups of one prior
GROUPED = sorted(path for path in CONF.rglob("*.yaml") if path.parent not in UNTYPED)


def group_and_option(path: Path) -> tuple[str, str]:
    return str(path.parent.relative_to(CONF)), path.stem


OPTIONS = {
    group: [option for other, option in map(group_and_option, GROUPED) if other == group]
    for group in dict.fromkeys(group for group, _ in map(group_and_option, GROUPED))
}


@cache
def together(number: int) -> dict:
    """The config of a run with each group's option of that number, counted round."""
    everywhere = OPTIONS.keys() - OF_COMMANDS.keys() - OF_PRIORS.keys()
    chosen = {group: OPTIONS[group][number % len(OPTIONS[group])] for group in sorted(everywhere)}
    return OmegaConf.to_container(compose(*(f"{group}={option}" for group, option in chosen.items())), resolve=False)


@cache
def composed(group: str, option: str) -> dict:
    """The config of the command that has the group; options of several groups are composed together."""
    if group in OF_PRIORS:
        return OmegaConf.to_container(compose(OF_PRIORS[group], f"{group}={option}"), resolve=False)
    if group not in OF_COMMANDS:
        return together(OPTIONS[group].index(option))
    config = configure.compose(f"{group}={option}", name=OF_COMMANDS[group])
    return {group: OmegaConf.to_container(config[group], resolve=False)}


def targets(node):
    """All nodes of a composed config that name a class."""
    if isinstance(node, dict):
        if "_target_" in node:
            yield node
        for value in node.values():
            yield from targets(value)


def test_every_option_composes_and_its_keys_are_parameters():
    wrong = []
    for path in GROUPED:
        group, option = group_and_option(path)
        nodes = list(targets(composed(group, option)))
        wrong += [] if nodes else [f"{group}={option} names no class"]
        for node in nodes:
            parameters = inspect.signature(hydra.utils.get_class(node["_target_"])).parameters
            keys = {key for key in node if not key.startswith("_")}
            required = {
                name
                for name, p in parameters.items()
                if p.default is p.empty and p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)
            }
            wrong += [f"{group}={option}: {node['_target_']} has no {key}" for key in keys - set(parameters)]
            wrong += [f"{group}={option}: {node['_target_']} needs {key}" for key in required - keys]
    assert not wrong


def test_every_option_of_slam_instantiates():
    chosen = {group: options for group, options in OPTIONS.items() if group.startswith("slam/")}
    for number in range(max(map(len, chosen.values()))):
        config = slam_config(*(f"{group}={options[number % len(options)]}" for group, options in chosen.items()))
        assert isinstance(config, SlamConfig)


def test_points_are_the_frames_own_where_these_err_alike_unless_a_key_or_the_paper_says_otherwise():
    stereo = "prior=multiview_stereo"
    for words, points in (
        (["prior=simulated"], "map"),
        ([stereo], "own"),
        ([stereo, "experiment=paper"], "map"),
        ([stereo, "densify.points=map"], "map"),
    ):
        assert compose(*words).densify.points == points


def test_the_paper_preset_has_table_i_and_every_printed_reading():
    """Table I, and the column *printed* of docs/readings.md."""
    printed = {
        "window_size": 10,
        "observation.thin": 1,
        "fit.points_per_gaussian": 128,
        "em.num_neighbours": 16,
        "em.min_normal_cos": 0.5,
        "em.normal_weight": 5.0,
        "em.feature_weight": 5.0,
        "em.max_mahalanobis_sq": 4.6,
        "refinement.num_candidates": 3,
        "refinement.max_mahalanobis_sq_2d": 4.6,
        "initialization": "merged",
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
    paper = configure.compose("experiment=paper").slam
    assert {key: OmegaConf.select(paper, key) for key in printed} == printed
    assert configure.compose("experiment=paper", "slam.em.num_neighbours=7").slam.em.num_neighbours == 7


@cache
def config_classes():
    """Every class of conf/ that holds settings only, the config classes that they hold, and the keys that hold each."""
    found: dict[type, set[str]] = {}

    def visit(module, key):
        if not dataclasses.is_dataclass(module) or hasattr(module, "fingerprint"):  # a data set checks its own
            return
        is_new = module not in found
        found.setdefault(module, set()).add(key)
        for base in module.__bases__:
            visit(base, key)
        if is_new:
            for name, hint in typing.get_type_hints(module).items():
                for part in (hint, *typing.get_args(hint)):
                    if inspect.isclass(part):
                        visit(part, name)

    def visit_nodes(node, key):
        if isinstance(node, dict):
            if "_target_" in node:
                visit(hydra.utils.get_class(node["_target_"]), key)
            for name, value in node.items():
                visit_nodes(value, name)

    for group, option in map(group_and_option, GROUPED):
        visit_nodes(composed(group, option), "")
    return found


def last_name(node) -> str:
    """`c` of a.b.c and of c, and of a.b.c.config."""
    if isinstance(node, ast.Attribute):
        inner = last_name(node.value)
        return inner if node.attr == "config" and inner not in ("self", "") else node.attr
    return node.id if isinstance(node, ast.Name) else ""


class Reads(ast.NodeVisitor):
    """Which fields of which config classes a file reads: of what is annotated as such, is held under the key that it
    has in conf/, or is called as its class is."""

    def __init__(self, classes: dict[type, set[str]]) -> None:
        self.names, self.found, self.owner = {module.__name__ for module in classes}, set(), ""
        self.of_key: dict[str, set[str]] = {}
        for module, keys in classes.items():
            own = re.sub(r"(?<!^)(?=[A-Z])", "_", module.__name__.removesuffix("Config")).lower()
            for key in keys | {own}:
                self.of_key.setdefault(key, set()).add(module.__name__)

    def read(self, tree: ast.AST) -> set[tuple[str, str]]:
        self.of_name = {key: set(names) for key, names in self.of_key.items()}
        for node in ast.walk(tree):
            is_typed = isinstance(node, ast.arg | ast.AnnAssign) and node.annotation is not None
            if is_typed:
                words = set(re.findall(r"\w+", ast.unparse(node.annotation)))
                words |= {f"{word}Config" for word in words}  # `end.config` of a BackEnd is a BackEndConfig
                name = node.arg if isinstance(node, ast.arg) else last_name(node.target)
                self.of_name.setdefault(name, set()).update(words & self.names)
        for _ in range(2):  # names for such a name
            for node in ast.walk(tree):
                if isinstance(node, ast.Assign) and len(node.targets) == 1:
                    self.rename(node.targets[0], node.value)
        self.visit(tree)
        return self.found

    def rename(self, target, value) -> None:
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            for one, other in zip(target.elts, value.elts, strict=False):
                self.rename(one, other)
        elif last_name(target) and last_name(value) in self.of_name:
            self.of_name.setdefault(last_name(target), set()).update(self.of_name[last_name(value)])

    def visit_ClassDef(self, node) -> None:
        before, self.owner = self.owner, node.name
        self.generic_visit(node)
        self.owner = before

    def visit_Attribute(self, node) -> None:
        if isinstance(node.ctx, ast.Load):
            base = last_name(node.value)
            owners = {self.owner} if base == "self" else self.of_name.get(base, set())
            self.found |= {(owner, node.attr) for owner in owners}
        self.generic_visit(node)


# Written into results as a whole, by `dataclasses.asdict`.
ONLY_WRITTEN = {"EvaluationConfig.protocol"}


def test_every_field_of_a_config_class_is_read():
    """By `config.name` where config is of that class, by its annotation or the key that holds it: an attribute of that
    name of anything else does not count."""
    classes = config_classes()
    paths = [path for folder in ("emgs_jax", "experiments") for path in (ROOT / folder).rglob("*.py")]
    reads = Reads(classes)
    read = set().union(*(reads.read(ast.parse(path.read_text())) for path in paths))
    assert {"SlamConfig", "IcpConfig", "DensifyConfig", "EvaluationConfig", "MaskConfig", "SweepConfig"} <= reads.names
    unread = set()
    for module in classes:
        family = [other.__name__ for other in classes if issubclass(other, module) or issubclass(module, other)]
        for field in dataclasses.fields(module):
            if not any((name, field.name) in read for name in family):
                unread.add(f"{module.__name__}.{field.name}")
    assert unread == ONLY_WRITTEN


def test_every_number_of_a_config_class_declares_its_range():
    """A threshold that takes any value takes nan; `emgs_jax.config.values` refuses what is out of range."""
    numeric = re.compile(r"\bint\b|\bfloat\b|Float\[")
    without = [
        f"{module.__name__}.{field.name}"
        for module in config_classes()
        for field in dataclasses.fields(module)
        if numeric.search(str(field.type)) and not {"range", "choices"} & field.metadata.keys()
    ]
    assert sorted(without) == ["ImageConfig.mean", "ImageConfig.std"], "colours: any finite number"


SHARES = {"cosine_weight", "forgetting", "min_alpha", "min_inlier_fraction", "opacity", "pose_shared"}


def test_a_gate_can_be_closed_a_share_is_from_none_to_all_and_a_cosine_at_most_one():
    ranges = {
        f"{module.__module__}.{field.name}": field.metadata["range"]
        for module in config_classes()
        for field in dataclasses.fields(module)
        if "range" in field.metadata and ".polish." not in module.__module__  # whose opacity is a logit's
    }
    of = lambda is_meant: {key: r for key, r in ranges.items() if is_meant(key.split(".")[-1])}  # noqa: E731
    shares, cosines = of(SHARES.__contains__), of(lambda name: name.endswith("_cos"))
    gates = of(re.compile(r"max_.*(_sq|_gap|_step|_rad|_std|_distance|residual|misfit|field|margin|_odds)").match)
    assert len(shares) > 6 and len(cosines) > 6 and len(gates) > 12
    assert {key: (r.low, r.high) for key, r in shares.items()} == dict.fromkeys(shares, (0, 1))
    assert all(r.high == 1 and r.low in (-1, 0, -math.inf) for r in cosines.values())
    assert {key: r.low for key, r in gates.items()} == dict.fromkeys(gates, 0)


def test_a_value_that_stands_in_a_constructor_too_is_the_same_there():
    """conf/ is where a value is looked up; a class that can be made by hand must not disagree with it."""
    for group, option in map(group_and_option, GROUPED):
        if option not in ("default", "paper", "none", group):
            for node in targets(composed(group, option)):
                if node["_target_"].startswith(("emgs_jax.data.", "emgs_jax.prior.")):
                    parameters = inspect.signature(hydra.utils.get_class(node["_target_"])).parameters
                    for key, value in node.items():
                        default = parameters[key].default if key in parameters else inspect.Parameter.empty
                        if default is not inspect.Parameter.empty and str(default) != "<factory>":
                            assert (list(default) if isinstance(default, tuple) else default) == value, key

"""Compose conf/ with overrides, and build data set and prior; without JAX, which recording predictions may lack."""

import copy
import difflib
import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.singleton import Singleton
from hydra.errors import ConfigCompositionException, HydraException, InstantiationException, MissingConfigException
from hydra.utils import get_class, instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue
from tqdm import tqdm

from emgs_jax.config.overrides import readable
from emgs_jax.config.schema import register
from emgs_jax.config.values import check_values, declared
from emgs_jax.data.masks import Masks
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.prior.base import Prior
from emgs_jax.prior.files.conventions import check_truth
from emgs_jax.prior.wrapped import Featured, Masked, Requeried

if TYPE_CHECKING:
    from emgs_jax.back_end.state import BackEndConfig
    from emgs_jax.evaluation.baselines import BaselineConfig
    from emgs_jax.structure.config import StructureConfig

# Installed below the package, in a clone beside it.
CONF = next(
    folder for folder in (Path(__file__).parents[1] / "conf", Path(__file__).parents[2] / "conf") if folder.is_dir()
)

RENAMED = {  # keys of earlier versions; the longest match counts
    "slam.continuation": "slam.extrapolation",
    "slam.localization.min_eigenvalue": "slam.localization.max_pose_std",
    "graph.appearance": "graph.place_recognition",
    "graph.agreement": "graph.consistency",
    "graph.agreement.max_contradicted": "graph.consistency.max_violating_queries",
    "graph.verification.max_contradicted": "graph.verification.max_free_space_violation",
    "graph.verification.contradiction_margin": "graph.verification.free_space_margin",
    "graph.revisit": "graph.prior_query",
    "graph.revisit.is_asked": "graph.prior_query.is_used",
    "graph.revisit.num_asked": "graph.prior_query.max_queries",
    "graph.location": "graph.relocalization",
    "graph.max_known": "graph.min_violation",
    "prior.structure.masks": "masks.folder",
    "prior.dense.depth.depth_step": "prior.dense.depth_step",
}
OPEN = ("baseline", "variants", "tolerances", "suite")  # nodes that take any name
NO_WORD = (ValueError, TypeError, AssertionError)  # raised by Hydra if an option of a group is no word


def build(config: DictConfig, key: str, **more: Any) -> Any:
    """Check the values of the node at a dotted `key` and instantiate it; ValueError for wrong values and wrong keys."""
    if not isinstance(OmegaConf.select(config, key), DictConfig):
        raise ValueError(f"{key}={OmegaConf.select(config, key)} would replace all of its keys")
    check_values(config, key)
    node = OmegaConf.select(config, key)
    try:
        return instantiate(node, **more)
    except InstantiationException as error:
        if isinstance(error.__cause__, TypeError):  # an unknown key, from an earlier version or added with +
            raise ValueError(f"the keys of {key} are not those of {node.get('_target_')}: {error.__cause__}") from error
        raise


def graph_config(config: DictConfig) -> "BackEndConfig | None":
    """The back end's settings; None with `graph=none`."""
    return build(config, "graph", _convert_="all") if config.graph else None


def compose(*overrides: str, name: str = "config") -> DictConfig:
    """Compose conf/`name`.yaml with overrides; ValueError if one names no key or option."""
    overrides = tuple(readable(overrides))
    with _hydra():
        try:
            config = hydra.compose(name, list(overrides))
        except (ConfigCompositionException, MissingConfigException, *NO_WORD) as error:
            raise ValueError(_explained(error, name, overrides)) from error
        except HydraException as error:  # from the grammar
            raise ValueError(str(error)) from error
    for group, options in groups().items():
        value = OmegaConf.select(config, group.replace("/", "."), default={})
        if not isinstance(value, Mapping | DictConfig):
            raise ValueError(
                f"{group.replace('/', '.')}={value} would replace all of its keys: choose one of its options "
                f"({', '.join(options)}) with {group}={value if value in options else options[0]}"
            )
    return config


def check_added(overrides: Sequence[str], name: str = "config") -> None:
    """Raise ValueError, with near names, if an override with + adds a key to conf/`name`.yaml that nobody reads."""
    parsed = OverridesParser.create().parse_overrides(readable(overrides))
    added = [override for override in parsed if override.is_add() or override.is_force_add()]
    if not added:
        return
    config = compose(*(override.input_line for override in parsed if override not in added), name=name)
    known = keys_of(config)
    for override in added:
        key = override.key_or_group
        parents = [key.rsplit(".", count)[0] for count in range(1, key.count(".") + 1)]
        parent = next((one for one in parents if one in known), "")
        if key in {*known, *groups()} or key.partition(".")[0] in ("hydra", *OPEN) or _is_read(config, parent, key):
            continue
        raise ValueError(
            f"{override.input_line} would have no effect: {key} is no key of the config; {near(key, sorted(known))}"
        )


def _is_read(config: DictConfig, parent: str, key: str) -> bool:
    """Test whether a class takes what is added below a node: one of its parameters, or any key of a dict of its."""
    above = [parent, *(parent.rsplit(".", count)[0] for count in range(1, parent.count(".") + 1))] if parent else []
    made = next((one for one in above if "_target_" in (OmegaConf.select(config, one) or ())), None)
    if made is None:
        return False
    target = get_class(OmegaConf.select(config, made)["_target_"])
    takes_any = any(one.kind is one.VAR_KEYWORD for one in inspect.signature(target).parameters.values())
    return takes_any or made != parent or key.removeprefix(f"{made}.") in declared(target)


@contextmanager
def _hydra() -> Iterator[None]:
    """Initialise Hydra over conf/ and restore its state at the end, so that this works within its programs."""
    register()
    before = copy.deepcopy(Singleton.get_state())
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
            yield
    finally:
        Singleton.set_state(before)


def groups() -> dict[str, list[str]]:
    """The groups of conf/ with their options."""
    found: dict[str, list[str]] = {}
    for path in sorted(CONF.rglob("*.yaml")):
        if path.parent != CONF and not path.stem.startswith("_"):
            found.setdefault(path.parent.relative_to(CONF).as_posix(), []).append(path.stem)
    return found


def _explained(error: Exception, name: str, overrides: Sequence[str]) -> str:
    """Explain an error in the overrides, with keys or options that might have been meant."""
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    options = groups()
    if needed := re.match(r"You must specify '([\w/]+)'", str(error)):
        return f"{needed[1]} is not given: choose {needed[1]}= one of {', '.join(options.get(needed[1], ()))}"
    if other := re.match(r"Could not override '(\w+)/(\w+)'", str(error)):
        paths, needle = (CONF / other[1]).glob("*.yaml"), f"- {other[2]}:"
        owners = [path.stem for path in paths if needle in path.read_text(encoding="utf-8")]
        if owners:
            return f"{other[1]}/{other[2]} is a choice of {other[1]}={', '.join(owners)} only"
    choices = [override for override in parsed if override.key_or_group.split("@")[0] in options]
    paths = [override for override in parsed if override.key_or_group == "hydra.searchpath"]  # with the user's options
    for override in () if paths else choices:
        group = override.key_or_group
        if override.value() is not None and str(override.value()) not in options.get(group, [str(override.value())]):
            return f"{override.input_line} is no option of {group}: there are {', '.join(options[group])}"
    values = [override for override in parsed if override not in choices]
    try:
        known = keys_of(hydra.compose(name, [override.input_line for override in [*choices, *paths]]))
    except (HydraException, *NO_WORD):
        return f"{' '.join(overrides)}: {error}"
    for override in values:
        key = override.key_or_group
        parts = [group for group in options if group.startswith(f"{key}/")]
        if parts:
            return f"{override.input_line}: {key} is chosen by its parts: {', '.join(f'{part}=…' for part in parts)}"
        if not override.is_add() and not key.startswith("hydra") and key not in known:
            new = renamed(key)
            return f"{key} is called {new} now" if new else f"{key} is no key of the config; {near(key, sorted(known))}"
    return f"{' '.join(overrides)}: {error}"


def renamed(key: str) -> str | None:
    """The current name of a key or group of an earlier version; None if it was not renamed."""
    for old in sorted(RENAMED, key=len, reverse=True):
        if key.replace("/", ".") == old or key.startswith(f"{old}."):
            new = RENAMED[old] + key[len(old) :]
            return new.replace(".", "/") if "/" in key else new
    return None


def first_of_sweep(override: Override) -> str:
    """The override with the first value of a sweep."""
    if not override.is_sweep_override():
        return override.input_line
    return f"{override.get_key_element()}={next(iter(override.sweep_string_iterator()))}"


def keys_of(config: DictConfig) -> set[str]:
    found = set()

    def walk(node: Any, path: tuple[str, ...]) -> None:
        found.add(".".join(path))
        if isinstance(node, Mapping):
            for name, value in node.items():
                walk(value, (*path, str(name)))

    walk(OmegaConf.to_container(config, resolve=False), ())
    return found - {""}


def near(key: str, known: Sequence[str]) -> str:
    """Name the keys that `key` may have meant."""
    known = [name for name in known if not name.rpartition(".")[2].startswith("_")]
    parent, _, last = key.rpartition(".")
    ends = {name: name.rpartition(".")[2] for name in known}
    siblings = [name for name in known if name == f"{parent}.{ends[name]}"]
    similar = difflib.get_close_matches(last, set(ends.values()), 5)
    found = [name for name in known if ends[name] == last] + difflib.get_close_matches(key, siblings, 5)
    found += [name for end in similar for name in siblings if ends[name] == end] or siblings[:5]
    found += difflib.get_close_matches(key, known, 5) + [name for name in known if ends[name] in similar]
    found = list(dict.fromkeys(found))[:5] or difflib.get_close_matches(key, known, 5, 0)
    return f"near names: {', '.join(found)}"


def build_dataset(config: DictConfig, folder: Path | None = None) -> ReadableFrames:
    """Build the data set of a config; `folder` keeps a structure that intrinsics are estimated from."""
    given: dict[str, Any] = {}
    if config.dataset.get("intrinsics") == "estimate":
        from emgs_jax.structure.sequence import calibrate  # slow to import

        structure = folder and folder / "structure"
        given["intrinsics"] = partial(calibrate, config=structure_config(config), folder=structure)
    if "record" in config.dataset:
        given["folder"] = folder
    dataset = build(config, "dataset", **given)
    if "note" in dataset.calibration:
        tqdm.write(dataset.calibration["note"])
    progress = partial(tqdm, desc="checking", unit="frame")
    masks = build(config, "masks", _convert_="all") if "masks" in config else Masks()
    frames = ReadableFrames(dataset, config.on_bad_frame, progress, masks)
    if frames.mask_note:
        tqdm.write(frames.mask_note)
    if "depth_scale" in config.dataset:  # None: the data set knows
        scale = config.dataset.depth_scale
        check_truth(frames, None if scale is None else float(scale))
    return frames


def structure_config(config: DictConfig) -> "StructureConfig":
    """The settings of a structure: the prior's, else the default."""
    has_own = OmegaConf.select(config, "prior.structure") is not None
    own = config if has_own else OmegaConf.merge(compose("prior=multiview_stereo"), {"masks": config.masks})
    return build(own, "prior.structure", _convert_="all")


def build_prior(config: DictConfig, dataset: ReadableFrames) -> Prior:
    """Build the prior of a config; ValueError if it cannot predict for the data set."""
    given = [name for name, value in config.get("scale", {}).items() if value is not None and name != "_target_"]
    if given and "metres" not in config.prior:
        raise ValueError(
            "scale= gives metres to prior=multiview_stereo, whose unit is unknown; this prior has one of its own "
            "(emgs export RUN scale=FACTOR writes copies of a finished run in another unit)"
        )
    known = {"classes": list(dataset.classes)} if "classes" in config.prior else {}
    prior = attach_features(config, dataset, build(config, "prior", **known))
    prior.check(dataset, config.slam.window_size)
    return Masked(prior) if dataset.has_masks else prior


def baseline_configs(config: DictConfig) -> dict[str, "BaselineConfig"]:
    """The baselines of a config by name; ValueError for one that is none."""
    for name, node in config.baseline.items():
        if not isinstance(node, DictConfig) or "_target_" not in node:
            raise ValueError(f"baseline.{name} is no baseline: choose baseline=voxel, tsdf, all or none")
    return {str(name): build(config, f"baseline.{name}") for name in config.baseline}


def attach_features(config: DictConfig, dataset: ReadableFrames, prior: Prior) -> Prior:
    """Add the features of a config; without a model the prior's own are compared with the text of a file."""
    features = config.features
    if "_target_" not in features:
        return prior if features.text is None else Requeried(prior, features.text)
    if "classes" not in features:  # the model's own
        return Featured(prior, build(config, "features"))
    classes = features.classes
    if classes is None:  # all names of the file, or the data set's
        classes = dataset.classes if features.text is None else ()
    return Featured(prior, build(config, "features", classes=list(classes)))


def message_of(error: Exception) -> str:
    """The message of the original error, without Hydra's wrapping and a system error's number."""
    cause = error.__cause__ if isinstance(error, InstantiationException) and error.__cause__ else error
    if isinstance(cause, MissingMandatoryValue) and cause.full_key:
        return f"{cause.full_key} is not given: add {cause.full_key}=…"
    if isinstance(cause, OSError) and cause.filename is not None:
        return f"{cause.filename}: {cause.strerror}"
    return str(cause) or type(cause).__name__

"""Structured configs for Hydra, from the fields of classes.

Values that users change are in conf/; others are defaults of fields. Both are keys of a run: `conf/graph/default.yaml`
begins with `schema`, which is made here of `BackEndConfig`.
"""

import dataclasses
import importlib.util
from collections.abc import Mapping
from functools import cache
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.utils import get_class
from omegaconf import MISSING

# Option of a group -> class whose fields it has.
SCHEMAS = {
    "checkpoint": "emgs_jax.mapping.checkpoint.CheckpointConfig",
    "densify": "emgs_jax.render.densify.DensifyConfig",
    "instances": "emgs_jax.evaluation.instances.InstanceConfig",
    "masks": "emgs_jax.data.masks.Masks",
    "render": "emgs_jax.render.composite.RenderConfig",
    "scale": "emgs_jax.scale.metres.ScaleConfig",
    "submap": "emgs_jax.gaussian_map.SubmapConfig",
    "baseline/of_tsdf": "emgs_jax.evaluation.baselines.TsdfConfig",
    "baseline/of_voxels": "emgs_jax.evaluation.baselines.VoxelConfig",
    "evaluation/schema": "emgs_jax.evaluation.reconstruction.EvaluationConfig",
    "features/files": "emgs_jax.features.checkpoint.DinoFiles",
    "features/image": "emgs_jax.features.images.ImageConfig",
    "graph/schema": "emgs_jax.back_end.state.BackEndConfig",
    "polish/schema": "emgs_jax.polish.fit.PolishConfig",
    "prior/compute": "emgs_jax.prior.network.framework.ComputeConfig",
    "prior/masks": "emgs_jax.prior.network.masks.MaskConfig",
    "prior/structure": "emgs_jax.structure.config.StructureConfig",
    "prior/dense/of_files": "emgs_jax.prior.multiview.depth_files.DepthFilesConfig",
    "prior/dense/of_meter": "emgs_jax.prior.multiview.monocular_network.MeterConfig",
    "prior/dense/of_network": "emgs_jax.prior.multiview.learned.LearnedConfig",
    "prior/dense/of_sweep": "emgs_jax.prior.multiview.swept.SweptConfig",
    "slam/em/schema": "emgs_jax.em.EmConfig",
    "slam/existence/schema": "emgs_jax.existence.ExistenceConfig",
    "slam/extrapolation/schema": "emgs_jax.surface_extrapolation.ExtrapolationConfig",
    "slam/fit/schema": "emgs_jax.gaussians.FitConfig",
    "slam/localization/icp": "emgs_jax.registration.problem.IcpConfig",
    "slam/localization/schema": "emgs_jax.localization.LocalizationConfig",
    "slam/motion/schema": "emgs_jax.motion.MotionConfig",
    "slam/observation/schema": "emgs_jax.observation.ObservationConfig",
    "slam/splitting/schema": "emgs_jax.splitting.SplittingConfig",
}
WITHOUT_JAX = ("masks", "features/files", "features/image", "prior/compute", "prior/masks")


@cache
def register() -> None:
    """Give Hydra the structured configs."""
    for name in SCHEMAS:
        group, _, option = name.rpartition("/")
        ConfigStore.instance().store(option, schema_of(name), group=group or None)


def schema_of(name: str) -> dict[str, Any]:
    """The node of a name in `SCHEMAS`; without keys if its class needs JAX, which recording predictions may lack."""
    if not has_jax() and name not in WITHOUT_JAX:
        return {"_target_": SCHEMAS[name]}
    return node_of(get_class(SCHEMAS[name]))


def has_jax() -> bool:
    try:
        return importlib.util.find_spec("jax") is not None
    except ValueError:  # blocked in this process
        return False


def node_of(cls: type, **given: Any) -> dict[str, Any]:
    """The node of a dataclass: its fields with their defaults, `???` without one."""
    values = {field.name: given.get(field.name, _default(field)) for field in dataclasses.fields(cls)}
    return {"_target_": f"{cls.__module__}.{cls.__qualname__}"} | values


def _default(field: dataclasses.Field) -> Any:
    make = field.default_factory
    if make is dataclasses.MISSING:
        if field.default is not dataclasses.MISSING:
            return _plain(field.default)
        return node_of(field.type) if dataclasses.is_dataclass(field.type) else MISSING
    cls, given = (make, {}) if isinstance(make, type) else (getattr(make, "func", None), getattr(make, "keywords", {}))
    return node_of(cls, **given) if dataclasses.is_dataclass(cls) else _plain(make())


def _plain(value: Any) -> Any:
    """Convert a value for YAML."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [*value] if isinstance(value, tuple) else value

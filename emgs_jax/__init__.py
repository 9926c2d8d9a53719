"""MonoEM-GS as pure functions in JAX: everything that a user needs, by name.

`map_sequence(load_config("dataset=images", …))` maps a sequence; for a loop of your own use `init_state` and `step`.
Importing this module loads nothing else: a name is loaded when it is first used. Import it before JAX, or JAX prints a
line for every executable that it reads from the compilation cache.
"""

# ruff: noqa: F401 (names for type checkers)

import ast
import os
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for editors and type checkers, and the list of names
    from emgs_jax.config.configure import build_dataset, build_prior, compose
    from emgs_jax.data.base import BadFrameError, Dataset, Frame
    from emgs_jax.device.settings import use_compilation_cache
    from emgs_jax.em import EmConfig, EmInfo, em_update
    from emgs_jax.evaluation.reconstruction import EvaluationConfig
    from emgs_jax.existence import (
        ExistenceConfig,
        fusion_evidence,
        merge_all_duplicates,
        merge_duplicates,
        update_existence,
    )
    from emgs_jax.gaussian_map import (
        AverageConfig,
        GaussianMap,
        SubmapConfig,
        confirmed,
        empty_map,
        grow,
        insert,
        new_map,
        select_submap,
        transformed,
        write_back,
    )
    from emgs_jax.gaussians import FitConfig, Gaussians, cluster, fit_to_points
    from emgs_jax.initialization import initialize
    from emgs_jax.io.map_file import load_map, save_map
    from emgs_jax.localization import CoarsePose, LocalizationConfig, LocalizationInfo, localize_coarse, localize_fine
    from emgs_jax.mapping.atlas import Atlas
    from emgs_jax.mapping.capacity import advance, start
    from emgs_jax.mapping.convert import FirstWindow, opening, to_camera, to_first_window, to_prediction
    from emgs_jax.mapping.finalize import in_prior_unit
    from emgs_jax.mapping.integrate import integrate
    from emgs_jax.mapping.merging import join
    from emgs_jax.mapping.pipeline import finish_run, map_frames
    from emgs_jax.mapping.records import FrameRecord
    from emgs_jax.mapping.run import MappingRun, new_run
    from emgs_jax.mapping.window_input import WindowInput, window_inputs
    from emgs_jax.observation import Observation, ObservationConfig, Prediction, observe, transform
    from emgs_jax.ops.camera import Camera, downscale
    from emgs_jax.prior.base import Prior, PriorPrediction, Provenance, Window, windows
    from emgs_jax.prior.recorded import Recorded, record
    from emgs_jax.refinement import RefinementConfig, RefinementInfo, refine
    from emgs_jax.registration.icp import IcpInfo, icp
    from emgs_jax.registration.problem import IcpConfig
    from emgs_jax.render.composite import RenderConfig, Rendering
    from emgs_jax.render.composite import render as render_gaussians
    from emgs_jax.render.densify import DensifyConfig, densify
    from emgs_jax.semantics import classify
    from emgs_jax.sequence import RunConfig, load_config, map_sequence
    from emgs_jax.slam import Overflow, SlamConfig, SlamState, StepInfo, init_state, step
    from emgs_jax.splitting import SplittingConfig, split
    from emgs_jax.surface_extrapolation import ExtrapolationConfig, extrapolate

# jaxlib 0.10.1 logs an error for every executable that it reads from a cache, for a hint to the compiler that no CPU
# lists as a feature. What does fail raises an exception. It reads this as it is loaded.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

_HOMES = {  # name -> file that has it and its name there, as they are imported above
    name.asname or name.name: (node.module, name.name)
    for node in ast.walk(ast.parse(Path(__file__).read_text(encoding="utf-8")))
    if isinstance(node, ast.ImportFrom) and f"{node.module}".startswith(f"{__name__}.")
    for name in node.names
}

__all__ = ["__version__", *_HOMES]  # noqa: PLE0604 (names from the list)

try:
    __version__ = version("emgs_jax")
except PackageNotFoundError:  # a clone that is not installed
    __version__ = "0+unknown"


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, own_name = _HOMES[name]
    globals()[name] = value = getattr(import_module(module), own_name)
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})

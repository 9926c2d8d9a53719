"""What the scripts share: a config becomes a data set and a prior, an error becomes one clear line."""

import contextlib
import os
from collections.abc import Iterator
from functools import partial

from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException
from tqdm import tqdm

from emgs_jax.data.readable import ReadableFrames
from emgs_jax.prior.base import Prior
from emgs_jax.prior.featured import Featured, Requeried


def build_dataset(config: DictConfig) -> ReadableFrames:
    """The data set of a config, without unreadable frames where it says so."""
    dataset = instantiate(config.dataset)
    return ReadableFrames(dataset, config.on_bad_frame, partial(tqdm, desc="checking", unit="frame"))


def build_prior(config: DictConfig, dataset: ReadableFrames) -> Prior:
    """The prior of a config; raises ValueError where it cannot answer for the data set."""
    known = {"classes": list(dataset.classes)} if "classes" in config.prior else {}
    prior = attach_features(config.features, dataset, instantiate(config.prior, **known))
    prior.check(dataset, config.slam.window_size)
    return prior


def measured(prior: Prior) -> dict[str, float]:
    """What a prior measured of itself while it predicted, under `prior/`; nothing for most."""
    return prior.report() if hasattr(prior, "report") else {}


def attach_features(config: DictConfig, dataset: ReadableFrames, prior: Prior) -> Prior:
    """The prior with the features of a config; without a feature model its own, compared with the text of a file."""
    if "_target_" not in config:
        return prior if config.text is None else Requeried(prior, config.text)
    classes = config.classes
    if classes is None:  # all names of the file, or the data set's
        classes = dataset.classes if config.text is None else ()
    return Featured(prior, instantiate(config, classes=list(classes)))


def use_compilation_cache(config: DictConfig) -> None:
    """Keep executables in the folder that the config names, for the next process; null keeps none."""
    if config.compilation_cache is not None:
        import jax  # here, because experiments.predict and experiments.embed run where there is no JAX

        jax.config.update("jax_compilation_cache_dir", os.path.expanduser(config.compilation_cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def message_of(error: Exception) -> str:
    """What is wrong, without Hydra's wrapping."""
    cause = error.__cause__ if isinstance(error, InstantiationException) and error.__cause__ else error
    return str(cause) or type(cause).__name__


@contextlib.contextmanager
def clear_errors() -> Iterator[None]:
    """End the program with the message of what is wrong with the input; HYDRA_FULL_ERROR=1 shows the traceback.

    In a multirun the error goes on to Hydra, which reports it after the other jobs; an exit would end them too.
    """
    try:
        yield
    except (ValueError, OSError, InstantiationException, OmegaConfBaseException) as error:
        is_multirun = HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
        if is_multirun or os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        raise SystemExit(f"error: {message_of(error)}\n(HYDRA_FULL_ERROR=1 shows where it was raised)") from None

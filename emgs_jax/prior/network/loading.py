"""Loading networks of the MapAnything framework: nothing is downloaded, and no parameter keeps a random value.

torch and the framework are imported in functions. What fails is one message with the file or package and the remedy.
"""

import contextlib
import hashlib
import importlib
import os
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from omegaconf.errors import OmegaConfBaseException

from emgs_jax.io.packages import companion_problem, first_line
from emgs_jax.prior.network.framework import CHECKPOINT_FILES, DOWNLOAD, MODELS

CLONE = "the clone of facebookresearch/map-anything"


def import_framework(name: str) -> ModuleType:
    """A module of torch or of the framework; ValueError with the commands that install it."""
    try:
        return importlib.import_module(name)
    except Exception as error:
        problem = companion_problem() if name != "torch" else None
        if problem is not None:
            raise ValueError(f"prior=mapanything cannot import {name}: {problem}") from error
        if not isinstance(error, ImportError):
            raise
        raise ValueError(
            f"prior=mapanything needs torch and the package mapanything, but {error}: in a clone of this repository, "
            'pip install -e ".[mapanything]"; then clone the GitHub repository facebookresearch/map-anything and in '
            "it, pip install --no-deps -e . (it is in no package index); or record with experiments.predict where both "
            "are installed and use prior=recorded here"
        ) from error


def pretrained(torch: ModuleType, folder: Path) -> Any:
    """MapAnything with the weights of a checkpoint; ValueError where they are damaged or not exactly its own."""
    models, safetensors = import_framework("mapanything.models"), import_framework("safetensors")
    weights = folder / "model.safetensors"
    try:
        with whole_weights(
            torch, str(weights), f"both files must be of one download: repeat {DOWNLOAD}", is_exact=True
        ):
            return models.MapAnything.from_pretrained(str(folder), strict=True)
    except safetensors.SafetensorError as error:
        raise ValueError(
            f"{weights} is no file of weights, or damaged ({first_line(error)}): repeat {DOWNLOAD}"
        ) from error


def configured(torch: ModuleType, name: str, device: str) -> Any:
    """A network that the framework composes from its own configuration, whose files must be in the caches already."""
    from hydra.core.global_hydra import GlobalHydra

    models, known = import_framework("mapanything.models"), MODELS[name]
    outer = GlobalHydra.instance().hydra  # the framework composes with Hydra too and would leave its own behind
    try:
        with whole_weights(torch, f"the file of {known.weights}", "download it again"):
            return models.init_model_from_config(name, device=device).eval()
    except ImportError as error:
        install = f"in {CLONE}, pip install -e '.{f'[{known.extra}]' if known.extra else ''}'"
        raise ValueError(f"prior.model={name} needs more ({error}): {companion_problem() or install}") from error
    except OmegaConfBaseException as error:
        raise ValueError(
            f"prior.model={name} reads its weights from the folder root_pretrained_checkpoints_dir, which is to be set "
            f"in configs/machine/default.yaml in {CLONE} ({error})"
        ) from error
    except OSError as error:
        raise ValueError(_missing_file(name, error)) from error
    except (ValueError, torch.cuda.OutOfMemoryError):  # some of the types above are ValueErrors, too
        raise
    except Exception as error:  # each format of weights has its own types of errors
        raise ValueError(
            f"prior.model={name} cannot be made ({first_line(error)}): if its weights are damaged, download them again "
            f"({known.weights})"
        ) from error
    finally:
        GlobalHydra.instance().hydra = outer


def _missing_file(name: str, error: OSError) -> str:
    weights = MODELS[name].weights
    if error.filename is not None:
        return (
            f"prior.model={name} needs the file {error.filename} ({error.strerror}): put its weights there "
            f"({weights}); root_pretrained_checkpoints_dir in configs/machine/default.yaml in {CLONE} says where"
        )
    return (
        f"what prior.model={name} loads ({weights}) is not in the local caches (HF_HOME, TORCH_HOME), and nothing is "
        f"downloaded at run time: download it once beforehand ({error})"
    )


@contextlib.contextmanager
def whole_weights(torch: ModuleType, source: str, remedy: str, is_exact: bool = False) -> Iterator[None]:
    """Refuse weights that leave a parameter as it was drawn, however little strict the framework is.

    Args:
        source: of the weights, for the message.
        is_exact: names that the network does not have are refused as well; MASt3R's file has more than what the
            framework's DUSt3R takes of it.
    """
    module = torch.nn.Module
    load = module.load_state_dict

    def load_whole(self: Any, state: Any, strict: bool = True, assign: bool = False) -> Any:
        does_not_fit = f"{source} does not fit {type(self).__name__}"
        try:
            result = load(self, state, False, assign)
        except RuntimeError as error:  # one line for each parameter of another shape
            lines = [line.strip() for line in str(error).splitlines()[1:]] or [first_line(error)]
            raise ValueError(f"{does_not_fit}, {_some(lines, 'of another shape')}: {remedy}") from error
        missing, more = _missing(self, state, result.missing_keys), list(result.unexpected_keys)
        parts = [_some(missing, "missing")] if missing else []
        parts += [_some(more, "that it does not have")] if more and (strict or is_exact) else []
        if parts:
            raise ValueError(f"{does_not_fit}, {' and '.join(parts)}: {remedy}")
        return result

    module.load_state_dict = load_whole
    try:
        yield
    finally:
        module.load_state_dict = load


def _missing(module: Any, state: Any, names: list[str]) -> list[str]:
    """Those of the names whose tensor has no other name in `state`: of two names of one tensor, files have one."""
    tensors = module.state_dict()
    loaded = {tensor.data_ptr() for name, tensor in tensors.items() if name in state}
    return [name for name in names if name not in tensors or tensors[name].data_ptr() not in loaded]


def _some(names: list[str], what: str) -> str:
    """Their number and the first three."""
    return f"{len(names)} {what} ({', '.join(names[:3])}{', …' if len(names) > 3 else ''})"


def digest(folder: Path) -> str:
    """SHA-256 over the SHA-256 of the checkpoint's files."""
    digests = []
    for name in CHECKPOINT_FILES:
        with (folder / name).open("rb") as handle:
            digests.append(hashlib.file_digest(handle, "sha256").hexdigest())
    return hashlib.sha256("".join(digests).encode()).hexdigest()


@contextlib.contextmanager
def offline(torch: ModuleType) -> Iterator[None]:
    """Let nothing be downloaded: the Hugging Face hub by its switch, torch.hub by loading from its cached clones."""
    os.environ["HF_HUB_OFFLINE"] = os.environ["TRANSFORMERS_OFFLINE"] = "1"
    with contextlib.suppress(ImportError):
        constants = importlib.import_module("huggingface_hub.constants")
        constants.HF_HUB_OFFLINE = True  # it has read the variable if something imported it before
    hub = torch.hub
    load, download = hub.load, hub.download_url_to_file

    def load_cached(repository: str, *arguments: Any, source: str = "github", **options: Any) -> Any:
        if source == "github":
            repository = str(_cached_clone(repository, Path(hub.get_dir())))
        return load(repository, *arguments, source="local", **options)

    def refuse(url: str, target: str, *arguments: Any, **options: Any) -> None:
        raise OSError(f"{target} is missing, and nothing is downloaded at run time: it belongs to {url}")

    hub.load, hub.download_url_to_file = load_cached, refuse
    try:
        yield
    finally:
        hub.load, hub.download_url_to_file = load, download


def _cached_clone(repository: str, hub: Path) -> Path:
    """torch.hub's copy of a repository `owner/name[:reference]`."""
    name, _, reference = repository.partition(":")
    clones = [
        hub / f"{name.replace('/', '_')}_{branch}" for branch in ([reference] if reference else ["main", "master"])
    ]
    for clone in clones:
        if (clone / "hubconf.py").is_file():
            return clone
    raise OSError(f"{clones[0]} has no hubconf.py: clone the GitHub repository {name} into that folder once")

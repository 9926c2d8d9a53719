"""Run MapAnything in torch, from arrays to arrays. Nothing is downloaded, and no parameter keeps a random value."""

import contextlib
import hashlib
import importlib
import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from emgs_jax.features.checkpoint import BACKBONE, digest
from emgs_jax.io.packages import best_device, companion_problem
from emgs_jax.prior.network.framework import (
    DOWNLOAD,
    USED_OUTPUTS,
    ComputeConfig,
    Network,
    NoAnswerError,
    View,
    check_checkpoint,
)


def import_framework(name: str) -> ModuleType:
    """Import a module of torch or of the framework; ValueError, with the commands that install it, if that fails."""
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


def pretrained(folder: Path) -> Any:
    """Load MapAnything with the weights of a checkpoint; ValueError if they are damaged or not exactly its own."""
    models, safetensors = import_framework("mapanything.models"), import_framework("safetensors")
    try:
        return models.MapAnything.from_pretrained(str(folder), strict=True)
    except (safetensors.SafetensorError, RuntimeError) as error:  # with a line for each parameter
        said = " ".join(str(error).split())[:500]
        raise ValueError(
            f"{folder / 'model.safetensors'} is damaged or no MapAnything's ({said}): repeat {DOWNLOAD}"
        ) from error


@contextlib.contextmanager
def offline(torch: ModuleType) -> Iterator[None]:
    """Prevent downloads: switch the Hugging Face hub offline, and let torch.hub load its cached clones."""
    os.environ["HF_HUB_OFFLINE"] = os.environ["TRANSFORMERS_OFFLINE"] = "1"
    with contextlib.suppress(ImportError):
        constants = importlib.import_module("huggingface_hub.constants")
        constants.HF_HUB_OFFLINE = True  # it has read the variable if it was imported before
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
    name, _, reference = repository.partition(":")
    branches = [reference] if reference else ["main", "master"]
    clones = [hub / f"{name.replace('/', '_')}_{branch}" for branch in branches]
    for clone in clones:
        if (clone / "hubconf.py").is_file():
            return clone
    raise OSError(f"{clones[0]} has no hubconf.py: clone the GitHub repository {name} into that folder once")


Call = Callable[[list[View]], list[View]]


class TorchNetwork:
    """A `Network` in torch; `call` maps views to the framework's outputs, all as tensors."""

    def __init__(self, call: Call, device: str, described: dict[str, Any]) -> None:
        self._call, self._device, self.described, self.peak_bytes = call, device, described, 0

    def infer(self, views: Sequence[View]) -> list[dict[str, np.ndarray]]:
        """The used outputs as arrays; ValueError if GPU memory is short, NoAnswerError if no camera fits the rays."""
        torch = import_framework("torch")
        height, width = views[0]["img"].shape[2:]
        with _memory_error(torch, f"{len(views)} images of {width}x{height}"), torch.no_grad():
            try:
                outputs = self._call([{key: self._tensor(torch, value) for key, value in v.items()} for v in views])
            except torch.linalg.LinAlgError as error:
                raise NoAnswerError(f"no camera fits the rays that the network gives ({error})") from error
            arrays = [{key: _array(output[key]) for key in USED_OUTPUTS if key in output} for output in outputs]
        if self._device.startswith("cuda"):
            self.peak_bytes = torch.cuda.max_memory_allocated(self._device)
        return arrays

    def _tensor(self, torch: ModuleType, value: Any) -> Any:
        return torch.from_numpy(value).to(self._device) if isinstance(value, np.ndarray) else value


def _array(value: Any) -> Any:
    """A tensor as array; NumPy has no bfloat16, so floating-point numbers become float32."""
    if not hasattr(value, "detach"):
        return value
    value = value.detach().cpu()
    return (value.float() if value.is_floating_point() else value).numpy()


def load_network(checkpoint: Path | None, compute: ComputeConfig) -> Network:
    """Load MapAnything from a local folder; ValueError if something is not installed, missing or set wrongly."""
    torch = import_framework("torch")
    import_framework("torch.hub")
    device = compute.device or best_device(torch, "prior=mapanything", "prior.compute.device")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(f"prior.compute.device={device}, but torch {torch.__version__} finds no GPU: use cpu or null")
    amp = compute.amp if device.startswith("cuda") else "float32"
    torch.backends.cudnn.benchmark, torch.backends.cudnn.deterministic = False, True
    with offline(torch), _memory_error(torch, "the weights"):
        check_checkpoint(checkpoint, Path(torch.hub.get_dir()))
        digests = "".join(digest(checkpoint / name) for name in BACKBONE)
        call = partial(
            pretrained(checkpoint).to(device).eval().infer,
            memory_efficient_inference=compute.memory_efficient,
            minibatch_size=compute.minibatch_size,
            use_amp=amp != "float32",
            amp_dtype="fp16" if amp == "fp16" else "bf16",
            apply_mask=False,  # masks.py masks the views in use
        )
    sha256 = hashlib.sha256(digests.encode()).hexdigest()
    return TorchNetwork(call, device, {"device": device.partition(":")[0], "amp": amp, "checkpoint_sha256": sha256})


@contextlib.contextmanager
def _memory_error(torch: ModuleType, what: str) -> Iterator[None]:
    try:
        yield
    except torch.cuda.OutOfMemoryError as error:
        raise ValueError(
            f"the GPU's memory does not suffice for {what} ({error}): lower slam.window_size (the anchor, the buffer, "
            "the current and the newest image go in together) or prior.resolution, set prior.compute.memory_efficient="
            "true and prior.compute.minibatch_size=1, and with XLA_PYTHON_CLIENT_PREALLOCATE=false let JAX reserve "
            "less. What experiments.predict has recorded stays valid"
        ) from error

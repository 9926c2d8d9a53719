"""A network of the MapAnything framework in torch: loaded from local files, arrays in, arrays out.

torch and the framework are imported when a network is loaded, and nothing is downloaded.
"""

import contextlib
import hashlib
import importlib
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from omegaconf.errors import OmegaConfBaseException

from emgs_jax.prior.network.framework import CHECKPOINT_FILES, MODELS, Network, NetworkSettings, View, check_checkpoint


class TorchNetwork:
    """A `Network` that runs in torch.

    Args:
        call: from the views as tensors to the framework's outputs as tensors.
        device: where the model is.
        described: as in `Network`.
    """

    def __init__(self, call: Callable[[list[View]], list[View]], device: str, described: dict[str, Any]) -> None:
        self._call, self._device, self.described, self.peak_bytes = call, device, described, 0

    def infer(self, views: Sequence[View]) -> list[dict[str, np.ndarray]]:
        """Return the outputs as arrays; ValueError where the GPU's memory does not suffice."""
        torch = _import("torch")
        height, width = views[0]["img"].shape[2:]
        with _memory_error(torch, f"{len(views)} images of {width}x{height}"), torch.inference_mode():
            outputs = self._call([{key: self._tensor(torch, value) for key, value in v.items()} for v in views])
            arrays = [{key: _array(value) for key, value in output.items()} for output in outputs]
        if self._device.startswith("cuda"):
            self.peak_bytes = torch.cuda.max_memory_allocated(self._device)
        return arrays

    def _tensor(self, torch: ModuleType, value: Any) -> Any:
        return torch.from_numpy(value).to(self._device) if isinstance(value, np.ndarray) else value


def _array(value: Any) -> Any:
    """The array of a tensor; NumPy has no bfloat16, so every floating-point number becomes a float32."""
    if not hasattr(value, "detach"):
        return value
    value = value.detach().cpu()
    return (value.float() if value.is_floating_point() else value).numpy()


def load_network(settings: NetworkSettings) -> Network:
    """Load a network from local files; ValueError naming what is not installed, missing or set wrongly."""
    torch, model = _import("torch"), MODELS[settings.model]
    _import("torch.hub")
    device = settings.compute.device or ("cuda" if torch.cuda.is_available() else "cpu")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(f"prior.compute.device={device}, but torch {torch.__version__} finds no GPU: use cpu or null")
    if model.needs_gpu and not device.startswith("cuda"):
        raise ValueError(f"prior.model={settings.model} cannot be built without a GPU: use prior.model=mapanything")
    amp = settings.compute.amp if device.startswith("cuda") else "float32"
    described = {"device": device.partition(":")[0], "amp": amp}
    torch.backends.cudnn.benchmark, torch.backends.cudnn.deterministic = False, True
    with _offline(torch), _memory_error(torch, f"the weights of {settings.model}"):
        if model.is_conditioned:
            check_checkpoint(settings.checkpoint, Path(torch.hub.get_dir()))
            described["checkpoint_sha256"] = _digest(settings.checkpoint)
            network = _import("mapanything.models").MapAnything.from_pretrained(str(settings.checkpoint))
            call = _conditioned_call(network.to(device).eval(), settings, amp)
        else:
            call = _plain_call(torch, _configured_model(settings.model, device), amp)
    return TorchNetwork(call, device, described)


def _conditioned_call(model: Any, settings: NetworkSettings, amp: str) -> Callable[[list[View]], list[View]]:
    def call(views: list[View]) -> list[View]:
        return model.infer(
            views,
            memory_efficient_inference=settings.compute.memory_efficient,
            minibatch_size=settings.compute.minibatch_size,
            use_amp=amp != "float32",
            amp_dtype="fp16" if amp == "fp16" else "bf16",
            apply_mask=False,  # upstream masks every view in NumPy; prior/masks.py does it for those in use
        )

    return call


def _plain_call(torch: ModuleType, model: Any, amp: str) -> Callable[[list[View]], list[View]]:
    postprocess = _import("mapanything.utils.inference").postprocess_model_outputs_for_inference
    dtype = {"bf16": torch.bfloat16, "fp16": torch.float16, "float32": None}[amp]

    def call(views: list[View]) -> list[View]:
        with torch.autocast("cuda", dtype=dtype) if dtype is not None else contextlib.nullcontext():
            raw = model(views)
        return postprocess(raw, views, apply_mask=False)

    return call


def _configured_model(name: str, device: str) -> Any:
    """A network that the framework composes from its own configuration, whose files must be in the caches already."""
    from hydra.core.global_hydra import GlobalHydra

    models, clone = _import("mapanything.models"), "the clone of facebookresearch/map-anything"
    outer = GlobalHydra.instance().hydra  # the framework composes with Hydra too and would leave its own behind
    try:
        return models.init_model_from_config(name, device=device).eval()
    except ImportError as error:
        extra = name.partition("_")[0]
        raise ValueError(f"prior.model={name} needs more ({error}): in {clone}, pip install -e '.[{extra}]'") from error
    except OmegaConfBaseException as error:
        raise ValueError(
            f"prior.model={name} reads its weights from the folder root_pretrained_checkpoints_dir, which is to be set "
            f"in configs/machine/default.yaml in {clone} ({error})"
        ) from error
    except OSError as error:
        raise ValueError(
            f"the weights of prior.model={name} ({MODELS[name].weights}) are not in the local caches (HF_HOME, "
            f"TORCH_HOME), and nothing is downloaded at run time: download them once beforehand ({error})"
        ) from error
    finally:
        GlobalHydra.instance().hydra = outer


def _import(name: str) -> ModuleType:
    """A module of torch or of the framework; ValueError with the commands that install it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ValueError(
            f"prior=mapanything needs torch and the package mapanything, but {error}: in a clone of this repository, "
            'pip install -e ".[mapanything]"; then clone the GitHub repository facebookresearch/map-anything and in '
            "it, pip install --no-deps -e . (it is in no package index); or record with experiments.predict where both "
            "are installed and use prior=recorded here"
        ) from error


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


def _digest(folder: Path) -> str:
    """SHA-256 over the SHA-256 of the checkpoint's files."""
    digests = []
    for name in CHECKPOINT_FILES:
        with (folder / name).open("rb") as handle:
            digests.append(hashlib.file_digest(handle, "sha256").hexdigest())
    return hashlib.sha256("".join(digests).encode()).hexdigest()


@contextlib.contextmanager
def _offline(torch: ModuleType) -> Iterator[None]:
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

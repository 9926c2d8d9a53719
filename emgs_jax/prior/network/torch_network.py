"""A network of the MapAnything framework in torch: arrays in, arrays out, in the precision that was asked for."""

import contextlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from emgs_jax.io.packages import best_device
from emgs_jax.prior.network.framework import (
    MODELS,
    USED_OUTPUTS,
    Network,
    NetworkSettings,
    NoAnswerError,
    View,
    check_checkpoint,
)
from emgs_jax.prior.network.loading import configured, digest, import_framework, offline, pretrained

Call = Callable[[list[View]], list[View]]


class TorchNetwork:
    """A `Network` that runs in torch.

    Args:
        call: from the views as tensors to the framework's outputs as tensors.
    """

    def __init__(self, call: Call, device: str, described: dict[str, Any]) -> None:
        self._call, self._device, self.described, self.peak_bytes = call, device, described, 0

    def infer(self, views: Sequence[View]) -> list[dict[str, np.ndarray]]:
        """Return the outputs in use as arrays.

        Raises:
            ValueError: the GPU's memory does not suffice.
            NoAnswerError: no camera fits the rays of a view.
        """
        torch = import_framework("torch")
        height, width = views[0]["img"].shape[2:]
        # Some networks end in an optimisation by gradients, which no_grad lets them switch on again.
        with _memory_error(torch, f"{len(views)} images of {width}x{height}"), torch.no_grad(), _same_draws(torch):
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
    """The array of a tensor; NumPy has no bfloat16, so every floating-point number becomes a float32."""
    if not hasattr(value, "detach"):
        return value
    value = value.detach().cpu()
    return (value.float() if value.is_floating_point() else value).numpy()


def load_network(settings: NetworkSettings) -> Network:
    """Load a network from local files; ValueError naming what is not installed, missing or set wrongly."""
    torch, model = import_framework("torch"), MODELS[settings.model]
    import_framework("torch.hub")
    device = _device(torch, settings)
    if model.needs_gpu and not device.startswith("cuda"):
        raise ValueError(f"prior.model={settings.model} cannot be built without a GPU: use prior.model=mapanything")
    amp = settings.compute.amp if device.startswith("cuda") and model.precision else "float32"
    described = {"device": device.partition(":")[0], "amp": amp}
    torch.backends.cudnn.benchmark, torch.backends.cudnn.deterministic = False, True
    with offline(torch), _memory_error(torch, f"the weights of {settings.model}"):
        if model.is_conditioned:
            check_checkpoint(settings.checkpoint, Path(torch.hub.get_dir()))
            described["checkpoint_sha256"] = digest(settings.checkpoint)
            network = pretrained(torch, settings.checkpoint).to(device).eval()
            call = _conditioned_call(network, settings, amp)
        else:
            network = configured(torch, settings.model, device)
            _set_precision(torch, network, settings.model, amp)
            call = _plain_call(network)
    return TorchNetwork(call, device, described)


def _device(torch: ModuleType, settings: NetworkSettings) -> str:
    """The device that is asked for, or the one there is; ValueError where it is asked for and not there."""
    device = settings.compute.device or best_device(torch, f"prior.model={settings.model}", "prior.compute.device")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(f"prior.compute.device={device}, but torch {torch.__version__} finds no GPU: use cpu or null")
    return device


def _conditioned_call(model: Any, settings: NetworkSettings, amp: str) -> Call:
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


def _set_precision(torch: ModuleType, model: Any, name: str, amp: str) -> None:
    """Put the precision where the framework's wrapper keeps its own choice, so that the provenance says what ran."""
    attribute = MODELS[name].precision
    if not attribute:
        return
    if not hasattr(model, attribute):
        raise ValueError(f"prior.model={name} keeps no .{attribute}: this version of mapanything is not supported")
    dtypes = {"bf16": torch.bfloat16, "fp16": torch.float16, "float32": torch.float32}
    names = {"bf16": "bf16", "fp16": "fp16", "float32": False}
    setattr(model, attribute, (dtypes if attribute == "dtype" else names)[amp])


def _plain_call(model: Any) -> Call:
    postprocess = import_framework("mapanything.utils.inference").postprocess_model_outputs_for_inference

    def call(views: list[View]) -> list[View]:
        with tempfile.TemporaryDirectory() as folder:
            if hasattr(model, "cache_dir"):  # MASt3R would take what it finds there under a view's name for the view's
                model.cache_dir = folder
            raw = model(views)
        return postprocess(raw, views, apply_mask=False)

    return call


@contextlib.contextmanager
def _same_draws(torch: ModuleType) -> Iterator[None]:
    """Let every call draw the same random numbers: the same question gets the same answer."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


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

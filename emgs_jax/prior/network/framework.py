"""Inputs and outputs of MapAnything, as arrays."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from emgs_jax.features.checkpoint import BACKBONE
from emgs_jax.ops.ranges import number, one_of
from emgs_jax.prior.network.resize import Resize, Size, resize_intrinsics

View = dict[str, Any]  # of the framework: `img`, `data_norm_type` and further inputs
MEAN, DEVIATION = (np.float32(rgb)[:, None, None] for rgb in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
NORM, PATCH = "dinov2", 14  # name of that normalisation of RGB in [0, 1]; sides of the grid are multiples of the patch
DINOV2_CLONE = "facebookresearch_dinov2_main"  # torch.hub's copy of the repository
DOWNLOAD = "hf download facebook/map-anything-apache --local-dir FOLDER"

USED_OUTPUTS = ("pts3d_cam", "conf", "non_ambiguous_mask", "camera_poses")  # a quarter of all


class NoAnswerError(ValueError):
    """The network's output for a window is unusable, such as rays that no camera has."""


@dataclass(frozen=True)
class ComputeConfig:
    """Device, precision and memory of a network."""

    device: str | None = None  # `cuda` or `cpu`; None: cuda if available
    amp: str = one_of("bf16", "fp16", "float32", default="bf16")  # on a GPU; a CPU computes in float32
    memory_efficient: bool = True  # run the dense heads in parts
    minibatch_size: int | None = number(1, low=1)  # images in a part; None: what fits, so bits depend on free memory


class Network(Protocol):
    """A loaded network."""

    described: dict[str, Any]  # for the provenance: device, precision, digest of the weights
    peak_bytes: int  # of GPU memory so far; 0 without a GPU

    def infer(self, views: Sequence[View]) -> list[dict[str, np.ndarray]]:
        """The framework's output of every view, with its batch axis."""
        ...


@dataclass(frozen=True)
class ViewOutput:
    """A network's output for one view, as far as the prior uses it."""

    points: np.ndarray  # camera frame, metres, float32 (h, w, 3) on its grid
    confidence: np.ndarray  # float32 (h, w); 1 if the network gives none
    is_clear: np.ndarray  # bool (h, w), False where the network calls the pixel ambiguous
    T_reference_view: np.ndarray  # camera -> the network's own frame, float64 (4, 4)


def build_views(
    images: Sequence[np.ndarray], intrinsics: Sequence[float], resize: Resize, anchor_is_metric: bool | None
) -> list[View]:
    """Make the framework's views from RGB images, uint8, on its grid; `intrinsics` are of the frames before `resize`.

    The first view is the anchor: it gets a pose, called metric or not, unless `anchor_is_metric` is None. The pose's
    value has no influence, as the network's poses are relative to the first view.
    """
    matrix, views = resize_intrinsics(intrinsics, resize)[None], []
    for image in images:
        normalized = (image.transpose(2, 0, 1).astype(np.float32) / 255 - MEAN) / DEVIATION
        views.append({"img": normalized[None], "data_norm_type": [NORM], "intrinsics": matrix})
    if anchor_is_metric is not None:
        views[0]["camera_poses"] = np.eye(4, dtype=np.float32)[None]
        views[0]["is_metric_scale"] = np.array([anchor_is_metric])
    return views


def read_output(output: Mapping[str, np.ndarray], grid: Size) -> ViewOutput:
    """Extract what the prior uses, without the batch axis; ValueError if it is missing or not of the grid's size."""
    missing = [key for key in ("pts3d_cam", "camera_poses") if key not in output]
    if missing:
        raise ValueError(f"the network's output has no {', '.join(missing)}: this version of it is not supported")
    points = np.asarray(output["pts3d_cam"][0], np.float32)
    shape = points.shape[:2]
    if shape != grid[::-1]:
        raise ValueError(f"the network was given images of {grid} and answered with points of {shape[::-1]}")
    return ViewOutput(
        points,
        np.asarray(output["conf"][0] if "conf" in output else np.ones(shape), np.float32),
        np.asarray(output["non_ambiguous_mask"][0] if "non_ambiguous_mask" in output else np.ones(shape), bool),
        np.asarray(output["camera_poses"][0], np.float64),
    )


def check_checkpoint(folder: Path | None, hub: Path) -> None:
    """Raise ValueError if a checkpoint of MapAnything cannot be loaded offline; `hub` must have a clone of DINOv2."""
    if folder is None:
        raise ValueError(f"prior.checkpoint is not set: download the weights once ({DOWNLOAD}) and name the FOLDER")
    missing = [name for name in BACKBONE if not (folder / name).is_file()]
    if missing:
        raise ValueError(f"{folder} has no {' and no '.join(missing)}: prior.checkpoint is the FOLDER of {DOWNLOAD}")
    path = folder / "config.json"
    try:
        encoder = dict(json.loads(path.read_text(encoding="utf-8"))["encoder_config"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is no configuration of MapAnything ({error!r}): repeat {DOWNLOAD}") from error
    if "dinov2" not in str(encoder.get("encoder_str")):
        return
    if encoder.get("torch_hub_pretrained") is not False:
        raise ValueError(
            f'{path} would make the encoder download weights that model.safetensors has too: add "torch_hub_pretrained"'
            ": false to its encoder_config"
        )
    if not (hub / DINOV2_CLONE / "hubconf.py").is_file():
        raise ValueError(
            f"{hub / DINOV2_CLONE} has no hubconf.py, and MapAnything's encoder needs the code of DINOv2: clone the "
            f"GitHub repository facebookresearch/dinov2 into that folder once (TORCH_HOME moves it)"
        )

"""The networks of the MapAnything framework: what is known of each, what it is given and what it gives, as arrays."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from emgs_jax.features.checkpoint import BACKBONE
from emgs_jax.ops.ranges import number, one_of
from emgs_jax.prior.network.resize import Resize, Size, resize_intrinsics

View = dict[str, Any]  # of the framework: `img`, `data_norm_type` and what else the network is told
NORMALIZATIONS = {  # of RGB in [0, 1]: mean, standard deviation
    "dinov2": ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)),
    "dust3r": ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
    "identity": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
}
DINOV2_CLONE = "facebookresearch_dinov2_main"  # the name that torch.hub gives to its copy of the repository
DOWNLOAD = "hf download facebook/map-anything-apache --local-dir FOLDER"


USED_OUTPUTS = ("pts3d_cam", "conf", "non_ambiguous_mask", "camera_poses", "intrinsics")  # a quarter of what there is


class NoAnswerError(ValueError):
    """The network's answer to a window is none, such as rays that no camera has."""


@dataclass(frozen=True)
class FrameworkModel:
    """Properties of a network that runs through the framework's wrappers.

    Args:
        norm: key of `NORMALIZATIONS`.
        resolution_set: key of `resize.HEIGHTS`.
        patch: width and height of its grid are multiples of this.
        scale: `metric`, `approximate` (metres, but not reliably) or `arbitrary` (a new unit in every call).
        weights: published weights and their licence.
        is_conditioned: it takes intrinsics and poses; the others take images only.
        needs_gpu: it cannot be built without one.
        extra: of the framework's package, which installs what the network needs beside it.
        precision: attribute of the framework's wrapper that holds its precision, `infer` where it is an argument; the
            others run in float32, because their wrappers optimise geometry as well.
        fields: that its wrapper reads in every view but ignores; keys of `_fields`.
    """

    norm: str
    resolution_set: int
    patch: int
    scale: str
    weights: str
    is_conditioned: bool = False
    needs_gpu: bool = False
    extra: str = ""
    precision: str = ""
    fields: tuple[str, ...] = ()


APACHE = "facebook/map-anything-apache: Apache-2.0 (facebook/map-anything: CC-BY-NC-4.0, no commercial use)"
DA3, DA3_NESTED = "DA3-GIANT-1.1: CC-BY-NC-4.0", "DA3NESTED-GIANT-LARGE-1.1: CC-BY-NC-4.0"
VGGT = "and DINOv2's code and weights in the cache of torch.hub"
MAST3R = "MASt3R, metric: CC BY-NC-SA 4.0"
_names, _inputs = ("label", "instance"), ("camera_intrinsics", "depthmap", "camera_pose", "true_shape")
_vggt = partial(FrameworkModel, "identity", 518, 14, "arbitrary", needs_gpu=True, precision="dtype")
_pi3 = partial(FrameworkModel, "identity", 518, 14, needs_gpu=True, precision="dtype", extra="pi3")
_da3 = partial(FrameworkModel, "dinov2", 504, 14, needs_gpu=True, precision="dtype", extra="depth-anything-3")
_dust3r = partial(FrameworkModel, "dust3r", 512, 16)
MODELS = {
    "mapanything": FrameworkModel("dinov2", 518, 14, "metric", APACHE, is_conditioned=True, precision="infer"),
    "vggt": _vggt(f"VGGT-1B: licence of its own; {VGGT}"),
    "vggt_commercial": _vggt(f"VGGT-1B-Commercial: gated; {VGGT}"),
    "pi3": _pi3("arbitrary", "Pi3: see its model card"),
    "pi3x": _pi3("approximate", "Pi3X: CC-BY-NC-4.0"),
    "da3": _da3("arbitrary", DA3),
    "da3_nested": _da3("metric", DA3_NESTED),
    "dust3r": _dust3r("arbitrary", "DUSt3R: CC BY-NC-SA 4.0", extra="dust3r"),
    "metric_dust3r": _dust3r("metric", MAST3R, extra="dust3r"),
    "mast3r": _dust3r("metric", MAST3R, extra="mast3r", fields=_names),
    "must3r": _dust3r(
        "arbitrary", "MUSt3R: no commercial use", needs_gpu=True, extra="must3r", precision="amp", fields=_names
    ),
    "pow3r_ba": _dust3r("arbitrary", "Pow3R: see its model card", extra="pow3r", fields=_inputs),
}


def _fields(row: int, height: int, width: int) -> dict[str, Any]:
    """Return placeholders for fields of a view that a wrapper reads although the network sees images only."""
    return {
        "label": ["window"],
        "instance": [f"{row:06d}"],
        "true_shape": np.array([[height, width]], np.int32),
        "camera_intrinsics": np.eye(3, dtype=np.float32)[None],
        "camera_pose": np.eye(4, dtype=np.float32)[None],
        "depthmap": np.zeros((1, height, width, 1), np.float32),
    }


@dataclass(frozen=True)
class ComputeConfig:
    """Settings for running a network: device, precision and memory.

    Args:
        device: `cuda` or `cpu`; None = cuda where there is one.
        amp: `bf16`, `fp16` or `float32` on a GPU. A CPU computes in float32.
        memory_efficient: run the dense heads in parts; `mapanything` only, as is
        minibatch_size: images in such a part; None = what fits into the free memory, on which the last bits of the
            result then depend.
    """

    device: str | None = None
    amp: str = one_of("bf16", "fp16", "float32", default="bf16")
    memory_efficient: bool = True
    minibatch_size: int | None = number(1, low=1)


class Network(Protocol):
    """A loaded network."""

    described: dict[str, Any]  # goes into the provenance: device, precision, digest of the weights
    peak_bytes: int  # of the GPU's memory so far; 0 without one

    def infer(self, views: Sequence[View]) -> list[dict[str, np.ndarray]]:
        """Return the framework's output of every view, batch axis included."""
        ...


@dataclass(frozen=True)
class ViewOutput:
    """Part of a network's output for one view that the prior uses.

    Args:
        points: camera frame, metres or the network's unit, float32 (h, w, 3) on its grid.
        confidence: float32 (h, w); 1 where the network gives none.
        is_clear: bool (h, w), False where the network calls the pixel ambiguous.
        T_reference_view: camera -> the network's own frame, float64 (4, 4).
        intrinsics: as the network sees them, float32 (3, 3).
    """

    points: np.ndarray
    confidence: np.ndarray
    is_clear: np.ndarray
    T_reference_view: np.ndarray
    intrinsics: np.ndarray

    def times(self, scale: float) -> "ViewOutput":
        """The same view in another unit of length."""
        pose = self.T_reference_view.copy()
        pose[:3, 3] *= scale
        return replace(self, points=self.points * np.float32(scale), T_reference_view=pose)


def build_views(
    images: Sequence[np.ndarray],
    intrinsics: Sequence[float],
    resize: Resize,
    model: FrameworkModel,
    anchor_is_metric: bool | None,
) -> list[View]:
    """Make the framework's views; the first is the anchor.

    Args:
        images: RGB, uint8, on the network's grid.
        intrinsics: fx, fy, cx, cy of the frames.
        resize: from the frames onto the grid.
        model: it decides the normalisation, and whether the intrinsics are told.
        anchor_is_metric: the anchor is given a pose, which is called metric or not; None gives it no pose. Its value
            has no influence, because the network expresses poses relative to the first view: it is the identity.
    """
    mean, deviation = (np.array(values, np.float32)[:, None, None] for values in NORMALIZATIONS[model.norm])
    views = []
    for row, image in enumerate(images):
        rgb = image.transpose(2, 0, 1).astype(np.float32) / 255
        told = _fields(row, *image.shape[:2])
        view = {"img": ((rgb - mean) / deviation)[None], "data_norm_type": [model.norm]}
        views.append(view | {key: told[key] for key in model.fields})
    if model.is_conditioned:
        for view in views:
            view["intrinsics"] = resize_intrinsics(intrinsics, resize)[None]
    if anchor_is_metric is not None:
        views[0]["camera_poses"] = np.eye(4, dtype=np.float32)[None]
        views[0]["is_metric_scale"] = np.array([anchor_is_metric])
    return views


def read_output(output: Mapping[str, np.ndarray], grid: Size) -> ViewOutput:
    """Take what the prior uses, without the batch axis; ValueError where it is not there or not of the grid's size."""
    missing = [key for key in ("pts3d_cam", "camera_poses", "intrinsics") if key not in output]
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
        np.asarray(output["intrinsics"][0], np.float32),
    )


def check_checkpoint(folder: Path | None, hub: Path) -> None:
    """Raise ValueError where a MapAnything checkpoint cannot be loaded without a network.

    Args:
        folder: has config.json and model.safetensors.
        hub: folder of torch.hub, where a clone of DINOv2's code must be.
    """
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

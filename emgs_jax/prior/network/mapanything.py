"""The networks of the MapAnything framework as a prior.

*Frame.* A network expresses everything in the frame of its first view, which is the anchor, but that view's own pose is
only approximately the identity. So poses are given out as inv(T_0) T_i, and points stay in their own camera.

*Scale.* A network whose scale is `arbitrary` uses a new unit in every call. What all calls share is the anchor's image,
so the unit is defined there: a prediction is scaled such that the median depth of the anchor's usable pixels is
`anchor_depth_m`. Consecutive windows then agree, nothing accumulates along the sequence, and a prediction depends on
its window alone, so that an interrupted recording can be continued. The result as a whole is up to one global scale.
Where the anchor has no usable pixel there is no scale: the mask is off and the poses are NaN.

*Grid.* Predictions are made on the network's grid and handed out at the frames' pixels, see `resize.to_frame`. Where
the data set's `size` is the grid, nothing is resampled.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from emgs_jax.data.base import Frame
from emgs_jax.prior.base import Prior, PriorPrediction, Provenance, Window, relative_poses
from emgs_jax.prior.network.framework import (
    MODELS,
    ComputeConfig,
    Network,
    NetworkSettings,
    NoAnswerError,
    ViewOutput,
    build_views,
    read_output,
)
from emgs_jax.prior.network.masks import MaskConfig, consistent, usable
from emgs_jax.prior.network.resize import Resize, Size, choose_grid, plan_resize, resize_image, to_frame
from emgs_jax.prior.network.torch_network import load_network

_usable, _consistent = eqx.filter_jit(usable), eqx.filter_jit(consistent)


class MapAnything(Prior):
    """A prior that asks a network of the framework.

    Args:
        model: name in `framework.MODELS`.
        checkpoint: folder with config.json and model.safetensors, for `mapanything`.
        resolution: (width, height) of the network's grid; None = the framework's choice for the frames' aspect.
        anchor_pose: give the anchor a pose, as the paper does; its value has no influence, that it is there has.
        anchor_is_metric: call that pose metric; the paper does not say.
        anchor_depth_m: median depth of the anchor, for networks of arbitrary scale.
        max_depth_step: relative depth difference across which nothing is interpolated.
        load: makes the network; tests put another one here.
    """

    def __init__(
        self,
        model: str,
        checkpoint: Path | str | None,
        resolution: Sequence[int] | None,
        anchor_pose: bool | str,
        anchor_is_metric: bool,
        anchor_depth_m: float,
        max_depth_step: float,
        compute: ComputeConfig,
        masks: MaskConfig,
        load: Callable[[NetworkSettings], Network] = load_network,
    ) -> None:
        _check_keys(model, resolution, anchor_pose, anchor_depth_m, compute)
        self._model, self._masks, self._max_depth_step = MODELS[model], masks, float(max_depth_step)
        self._resolution = None if resolution is None else (int(resolution[0]), int(resolution[1]))
        has_pose = self._model.is_conditioned and anchor_pose in (True, "on")
        self._anchor_is_metric = bool(anchor_is_metric) if has_pose else None
        self._anchor_depth_m = float(anchor_depth_m) if self._model.scale == "arbitrary" else None
        if checkpoint is not None and not self._model.is_conditioned:
            raise ValueError(
                f"prior.checkpoint is for prior.model=mapanything; {model} reads its weights from the caches"
            )
        folder = None if checkpoint is None else Path(checkpoint).expanduser()
        self._network = load(NetworkSettings(model, folder, compute))
        self._seconds: list[float] = []
        self._resized: dict[int, tuple[np.ndarray, Resize, np.ndarray]] = {}  # of the last window, by frame
        self.provenance = Provenance("mapanything", self._settings(model, compute) | self._network.described)

    def _settings(self, model: str, compute: ComputeConfig) -> dict[str, Any]:
        """Return what decides the predictions, as it took effect."""
        return {
            "version": 1,
            "model": model,
            "scale": self._model.scale,
            "anchor_depth_m": self._anchor_depth_m,
            "is_calibrated": self._model.is_conditioned,
            "anchor_pose": self._anchor_is_metric is not None,
            "anchor_is_metric": self._anchor_is_metric,
            "resolution": self._resolution,
            "max_depth_step": self._max_depth_step,
            "masks": {name: float(str(value)) for name, value in vars(self._masks).items()},  # .03, not .029999999
            "memory_efficient": compute.memory_efficient,
            "minibatch_size": compute.minibatch_size,
        }

    def report(self) -> dict[str, float]:
        """Return seconds of an inference (median, first), peak GPU memory (0 without one) and their number, if any."""
        if not self._seconds:
            return {}
        return {
            "prior/num_inferences": len(self._seconds),
            "prior/seconds_per_inference": median(self._seconds),
            "prior/seconds_of_first_inference": self._seconds[0],
            "prior/peak_gpu_mib": self._network.peak_bytes / 2**20,
        }

    def predict(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        """Predict for `frames` (in the order of `window.views`); see the module for frame, scale and grid.

        Where the network has no answer no pixel is valid and all poses but the anchor's are NaN.
        """
        size = check_frames(window, frames)
        resize = plan_resize(size, self._resolution or choose_grid(size, self._model.resolution_set))
        images = self._on_grid(frames, resize)
        views = build_views(images, intrinsics, resize, self._model, self._anchor_is_metric)
        begin = perf_counter()
        try:
            answers = self._network.infer(views)
        except NoAnswerError:
            return no_prediction(window, size)
        self._seconds.append(perf_counter() - begin)
        outputs = [read_output(answer, resize.grid) for answer in answers]
        dense = [window.views.index(index) for index in window.dense]
        outputs, valid = self._scaled(outputs, dense)
        T_anchor_view = relative_poses([output.T_reference_view for output in outputs])
        if self._masks.min_consistent_share > 0:
            valid = self._without_contradicted(outputs, valid, dense, T_anchor_view)
        return self._prediction(window, outputs, valid, T_anchor_view, resize)

    def _on_grid(self, frames: Sequence[Frame], resize: Resize) -> list[np.ndarray]:
        """Return the images on the grid; those that were in the last window are not resized again."""
        before, self._resized = self._resized, {}
        for frame in frames:
            image, plan, small = before.get(frame.index, (None, None, None))
            if plan != resize or not np.array_equal(image, frame.image):
                small = resize_image(frame.image, resize)
            self._resized[frame.index] = frame.image, resize, small
        return [self._resized[frame.index][2] for frame in frames]

    def _scaled(self, outputs: list[ViewOutput], dense: list[int]) -> tuple[list[ViewOutput], dict[int, np.ndarray]]:
        """Return the outputs in metres, and the masks of the views that are needed, by row."""
        anchor = {0} if self._anchor_depth_m is not None else set()
        needed = range(len(outputs)) if self._masks.min_consistent_share > 0 else sorted(anchor | {*dense})
        valid = {}
        for row in needed:
            view = outputs[row]
            mask = _usable(*map(jnp.asarray, (view.points, view.confidence, view.is_clear)), self._masks)
            valid[row] = np.asarray(mask)
        if self._anchor_depth_m is None:
            return outputs, valid
        depths = outputs[0].points[..., 2][valid[0]]
        scale = self._anchor_depth_m / float(np.median(depths)) if depths.size else np.nan
        if not depths.size:
            valid = {row: np.zeros_like(mask) for row, mask in valid.items()}
        return [scale_output(output, scale) for output in outputs], valid

    def _without_contradicted(
        self, outputs: list[ViewOutput], valid: dict[int, np.ndarray], dense: list[int], T_anchor_view: np.ndarray
    ) -> dict[int, np.ndarray]:
        """Return the masks of the dense views without the pixels that other views contradict."""
        depths = jnp.stack([jnp.where(valid[row], view.points[..., 2], 0.0) for row, view in enumerate(outputs)])
        intrinsics = jnp.stack([jnp.asarray(view.intrinsics) for view in outputs])
        poses = jnp.asarray(T_anchor_view, jnp.float32)
        return {
            row: valid[row] & np.asarray(_consistent(jnp.asarray(row), depths, intrinsics, poses, self._masks))
            for row in dense
        }

    def _prediction(
        self,
        window: Window,
        outputs: list[ViewOutput],
        valid: dict[int, np.ndarray],
        T_anchor_view: np.ndarray,
        resize: Resize,
    ) -> PriorPrediction:
        """Return the dense views at the pixels of the frames."""
        parts = []
        for index in window.dense:
            row = window.views.index(index)
            view, on = outputs[row], valid[row]
            points = np.where(on[..., None], view.points, 0).astype(np.float32)
            confidence = np.where(on, np.maximum(view.confidence, 1), 1).astype(np.float32)
            parts.append(to_frame(points, confidence, on, resize, self._max_depth_step))
        points, confidence, mask = (np.stack(arrays) for arrays in zip(*parts, strict=True))
        features = np.zeros((*mask.shape, 0), np.float16)
        return PriorPrediction(window, T_anchor_view, points, confidence, mask, features)


def _check_keys(
    model: str, resolution: Sequence[int] | None, anchor_pose: bool | str, anchor_depth_m: float, compute: ComputeConfig
) -> None:
    """Raise ValueError naming the key that has no sense."""
    if model not in MODELS:
        raise ValueError(f"prior.model must be one of {', '.join(MODELS)}; got {model!r}")
    patch = MODELS[model].patch
    if resolution is not None and (len(resolution) != 2 or any(side < patch or side % patch for side in resolution)):
        raise ValueError(
            f"prior.resolution must be (width, height) in multiples of {patch}, or null for the framework's own choice;"
            f" got {list(resolution)}"
        )
    if anchor_pose not in (True, False, "on", "off"):
        raise ValueError(f"prior.anchor_pose must be on or off, got {anchor_pose!r}")
    if not anchor_depth_m > 0:
        raise ValueError(f"prior.anchor_depth_m must be above 0 m, got {anchor_depth_m}")
    if compute.amp not in ("bf16", "fp16", "float32"):
        raise ValueError(f"prior.compute.amp must be bf16, fp16 or float32; got {compute.amp!r}")


def check_frames(window: Window, frames: Sequence[Frame]) -> Size:
    """Return the size of the frames; ValueError where they are not the window's or not of one size."""
    indices = tuple(frame.index for frame in frames)
    if indices != window.views:
        raise ValueError(f"frames must be those of window.views {window.views} in that order, got {indices}")
    first, size = frames[0], frames[0].image.shape[1::-1]
    for frame in frames:
        if frame.image.shape[1::-1] != size:
            raise ValueError(
                f"the images of one window must have one size, but frame {first.index} ({first.name}) has {size} and "
                f"frame {frame.index} ({frame.name}) {frame.image.shape[1::-1]}: bring them to one (dataset.size)"
            )
    return size


def no_prediction(window: Window, size: Size) -> PriorPrediction:
    """Build the prediction of a failed inference: no pixel is valid, and only the anchor has a pose."""
    width, height = size
    shape, poses = (len(window.dense), height, width), np.full((len(window.views), 4, 4), np.nan)
    poses[0] = np.eye(4)
    points, features = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 0), np.float16)
    return PriorPrediction(window, poses, points, np.ones(shape, np.float32), np.zeros(shape, bool), features)


def scale_output(output: ViewOutput, scale: float) -> ViewOutput:
    """The same view in another unit of length."""
    pose = output.T_reference_view.copy()
    pose[:3, 3] *= scale
    return replace(output, points=output.points * np.float32(scale), T_reference_view=pose)

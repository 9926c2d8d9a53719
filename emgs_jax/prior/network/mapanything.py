"""MapAnything as a prior.

*Frame.* The pose of the network's first view, the anchor, is only about the identity, so poses are inv(T_0) T_i. Points
stay in their own camera.

*Grid.* Predictions are resampled from the network's grid to the frames' pixels, see `resize.at_pixels`, unless the data
set's `size` is the grid.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np

from emgs_jax.data.base import Frame
from emgs_jax.prior.base import (
    DenseView,
    Prior,
    PriorPrediction,
    Provenance,
    Window,
    check_order,
    no_points,
    predicted,
    relative_poses,
)
from emgs_jax.prior.network.framework import (
    PATCH,
    ComputeConfig,
    Network,
    NoAnswerError,
    ViewOutput,
    build_views,
    read_output,
)
from emgs_jax.prior.network.masks import MaskConfig, usable
from emgs_jax.prior.network.resize import Resize, Size, at_pixels, choose_grid, on_grid_of, plan_resize, resize_image
from emgs_jax.prior.network.torch_network import load_network


class MapAnything(Prior):
    """MapAnything as a prior.

    Args:
        checkpoint: folder with config.json and model.safetensors.
        resolution: (width, height) of the network's grid; None: the framework's choice for the frames' aspect.
        anchor_pose: give the anchor a pose, as the paper does.
        anchor_is_metric: call that pose metric, which the paper leaves open.
        max_depth_step: relative depth difference across which nothing is interpolated.
        load: makes the network; tests replace it.
    """

    def __init__(
        self,
        checkpoint: Path | str | None,
        resolution: Sequence[int] | None,
        anchor_pose: bool | str,
        anchor_is_metric: bool,
        max_depth_step: float,
        compute: ComputeConfig,
        masks: MaskConfig,
        load: Callable[[Path | None, ComputeConfig], Network] = load_network,
    ) -> None:
        _check_keys(resolution, anchor_pose)
        self._masks, self._max_depth_step = masks, float(max_depth_step)
        self._resolution = None if resolution is None else (int(resolution[0]), int(resolution[1]))
        self._anchor_is_metric = bool(anchor_is_metric) if anchor_pose in (True, "on") else None
        self._network = load(None if checkpoint is None else Path(checkpoint).expanduser(), compute)
        self._seconds: list[float] = []
        settings = {
            "version": 2,
            "anchor_pose": self._anchor_is_metric is not None,
            "anchor_is_metric": self._anchor_is_metric,
            "resolution": self._resolution,
            "max_depth_step": self._max_depth_step,
            "masks": {name: float(value) for name, value in vars(masks).items()},
            "memory_efficient": compute.memory_efficient,
            "minibatch_size": compute.minibatch_size,
        }
        self.provenance = Provenance("mapanything", settings | self._network.described)

    def report(self) -> dict[str, float]:
        """Number of inferences, their seconds (median, first) and peak GPU memory; nothing before the first."""
        if not self._seconds:
            return {}
        return {
            "prior/num_inferences": len(self._seconds),
            "prior/seconds_per_inference": median(self._seconds),
            "prior/seconds_of_first_inference": self._seconds[0],
            "prior/peak_gpu_mib": self._network.peak_bytes / 2**20,
        }

    def predict(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        """Predict; without a usable output no pixel is valid, and all poses but the anchor's are NaN."""
        size = check_frames(window, frames)
        resize = plan_resize(size, self._resolution or choose_grid(size))
        images = [resize_image(frame.image, resize) for frame in frames]
        views = build_views(images, intrinsics, resize, self._anchor_is_metric)
        begin = perf_counter()
        try:
            answers = self._network.infer(views)
        except NoAnswerError:
            T_anchor_view = np.full((len(window.views), 4, 4), np.nan)
            T_anchor_view[0] = np.eye(4)
            return predicted(window, T_anchor_view, [no_points(size)] * len(window.dense))
        self._seconds.append(perf_counter() - begin)
        outputs = [read_output(answer, resize.grid) for answer in answers]
        T_anchor_view = relative_poses([output.T_reference_view for output in outputs])
        dense = [outputs[window.views.index(index)] for index in window.dense]
        return predicted(window, T_anchor_view, [self._at_frame(output, resize) for output in dense])

    def _at_frame(self, view: ViewOutput, resize: Resize) -> DenseView:
        on = usable(view.points, view.confidence, view.is_clear, self._masks)
        points = np.where(on[..., None], view.points, 0).astype(np.float32)
        confidence = np.where(on, np.maximum(view.confidence, 1), 1).astype(np.float32)
        pixels = on_grid_of(resize.frame, resize.scaled, resize.corner)
        return at_pixels(points, confidence, on, pixels, self._max_depth_step)


def _check_keys(resolution: Sequence[int] | None, anchor_pose: bool | str) -> None:
    """Raise ValueError, with the key, if a setting makes no sense."""
    if resolution is not None and (len(resolution) != 2 or any(side < PATCH or side % PATCH for side in resolution)):
        raise ValueError(
            f"prior.resolution must be (width, height) in multiples of {PATCH}, or null for the framework's own choice;"
            f" got {list(resolution)}"
        )
    if anchor_pose not in (True, False, "on", "off"):
        raise ValueError(f"prior.anchor_pose must be on or off, got {anchor_pose!r}")


def check_frames(window: Window, frames: Sequence[Frame]) -> Size:
    """The size of the frames; ValueError unless they are the window's and of one size."""
    check_order(window, frames)
    sizes = {frame.image.shape[1::-1] for frame in frames}
    if len(sizes) > 1:
        raise ValueError(f"the images of one window must have one size (dataset.size), got {sorted(sizes)}")
    return sizes.pop()

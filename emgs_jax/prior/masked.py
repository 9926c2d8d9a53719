"""A prior whose predictions leave out what the masks of its frames leave out: the one place where that happens."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from emgs_jax.data.base import Frame
from emgs_jax.prior.base import Prior, PriorPrediction, Window
from emgs_jax.prior.featured import Wrapped


class Masked(Wrapped):
    """A prior without a point where `Frame.mask` is."""

    def __init__(self, prior: Prior) -> None:
        super().__init__(prior)
        self.provenance, self.feature_names = prior.provenance, prior.feature_names
        self.text_features = prior.text_features

    def predict(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        return _without_masked(super().predict(window, frames, intrinsics), frames)

    def revisit(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction | None:
        found = super().revisit(window, frames, intrinsics)
        return None if found is None else _without_masked(found, frames)


def _without_masked(prediction: PriorPrediction, frames: Sequence[Frame]) -> PriorPrediction:
    masks = {frame.index: frame.mask for frame in frames}
    dense = [masks[index] for index in prediction.window.dense]
    is_out = np.stack([np.zeros(prediction.mask.shape[1:], bool) if mask is None else mask for mask in dense])
    return replace(prediction, mask=prediction.mask & ~is_out)

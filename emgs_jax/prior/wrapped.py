"""Priors that answer as another one does, but for its features, their texts, or what masks leave out."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from emgs_jax.data.base import Dataset, Frame
from emgs_jax.features.base import FeatureModel
from emgs_jax.features.text import load_text
from emgs_jax.prior.base import Prior, PriorPrediction, Provenance, Window


class Wrapped(Prior):
    """A prior that answers as another one does, but for what a subclass changes."""

    def __init__(self, prior: Prior) -> None:
        self._prior, self.provenance = prior, prior.provenance
        self.feature_names, self.text_features = prior.feature_names, prior.text_features

    def num_newer(self, window_size: int) -> int:
        return self._prior.num_newer(window_size)

    def keep(self, folder: Path) -> None:
        self._prior.keep(folder)

    def report(self) -> dict[str, float]:
        return self._prior.report()

    def check(self, dataset: Dataset, window_size: int) -> None:
        self._prior.check(dataset, window_size)

    def predict(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        return self._prior.predict(window, frames, intrinsics)

    def revisit(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction | None:
        return self._prior.revisit(window, frames, intrinsics)


class Featured(Wrapped):
    """A prior whose predictions have the features of a feature model in place of their own.

    Predictions of two visits keep the prior's own: only geometry is needed there.
    """

    def __init__(self, prior: Prior, model: FeatureModel) -> None:
        super().__init__(prior)
        self._model = model
        self._known: list[tuple[Frame, np.ndarray]] = []  # features of the window before
        features = {**model.settings, "model": model.identity}  # before the text: names all missing files
        self.feature_names, self.text_features = model.text.names, model.text.vectors
        features |= {"templates": [*model.text.templates]}
        geometry = prior.provenance
        self.provenance = Provenance(
            f"{geometry.name}+{model.identity['name']}",
            geometry.settings | {"features": features},
            geometry.is_simulated,
        )

    def check(self, dataset: Dataset, window_size: int) -> None:
        super().check(dataset, window_size)
        self._model.check(dataset)

    def predict(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        """Predict geometry, and describe the dense images; an image of the window before is not described again."""
        prediction = super().predict(window, frames, intrinsics)
        by_index = {frame.index: frame for frame in frames}
        known = [(by_index[index], self._features(by_index[index])) for index in window.dense]
        self._known = known
        return replace(prediction, features=np.stack([features for _, features in known]))

    def _features(self, frame: Frame) -> np.ndarray:
        for known, features in self._known:
            is_same = known.image is frame.image or np.array_equal(known.image, frame.image)
            if known.name == frame.name and is_same:
                return features
        return self._model.extract(frame)


class Requeried(Wrapped):
    """A prior whose features are a feature model's, with the text embeddings of a file of `experiments.embed`."""

    def __init__(self, prior: Prior, path: str) -> None:
        super().__init__(prior)
        features = prior.provenance.settings.get("features")
        if features is None:
            raise ValueError(
                f"features.text={path} goes with features of a model, but prior {prior.provenance.name} has none: "
                "choose features=… or a recording that was made with it"
            )
        text = load_text(path, features["model"])
        self.feature_names, self.text_features = text.names, text.vectors
        settings = prior.provenance.settings | {"features": features | {"templates": [*text.templates]}}
        self.provenance = replace(prior.provenance, settings=settings)


class Masked(Wrapped):
    """A prior without a point where `Frame.mask` is."""

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

"""Priors that change another one's features, text embeddings or masks."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from emgs_jax.data.base import Dataset, Frame
from emgs_jax.features.base import FeatureModel
from emgs_jax.features.text import load_text
from emgs_jax.prior.base import Prior, PriorPrediction, Window


class Wrapped(Prior):
    """A prior that delegates to another one, except for what a subclass changes."""

    def __init__(self, prior: Prior) -> None:
        self._prior, self.provenance, self.adjusts_poses = prior, prior.provenance, prior.adjusts_poses
        self.feature_names, self.text_features = prior.feature_names, prior.text_features

    def num_newer(self, window_size: int) -> int:
        return self._prior.num_newer(window_size)

    def num_first(self, window_size: int) -> int:
        return self._prior.num_first(window_size)

    def keep(self, folder: Path) -> None:
        self._prior.keep(folder)

    @property
    def metre(self) -> float:
        return self._prior.metre

    def report(self) -> dict[str, float]:
        return self._prior.report()

    def check(self, dataset: Dataset, window_size: int) -> None:
        self._prior.check(dataset, window_size)

    def predict(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        return self._prior.predict(window, frames, intrinsics)

    def revisit(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction | None:
        return self._prior.revisit(window, frames, intrinsics)


class Featured(Wrapped):
    """A prior with the features of a feature model; predictions of two visits need none."""

    def __init__(self, prior: Prior, model: FeatureModel) -> None:
        super().__init__(prior)
        self._model = model
        self._known: list[tuple[Frame, np.ndarray]] = []  # features of the window before
        features = {**model.settings, "model": model.identity}  # before the text: names all missing files
        self.feature_names, self.text_features = model.text.names, model.text.vectors
        features |= {"templates": [*model.text.templates]}
        name, settings = f"{self.provenance.name}+{model.identity['name']}", self.provenance.settings
        self.provenance = replace(self.provenance, name=name, settings=settings | {"features": features})

    def check(self, dataset: Dataset, window_size: int) -> None:
        super().check(dataset, window_size)
        self._model.check(dataset)

    def predict(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        """Predict geometry, and extract features of the dense images that the window before did not have."""
        prediction = super().predict(window, frames, intrinsics)
        by_index = {frame.index: frame for frame in frames}
        self._known = [(by_index[index], self._features(by_index[index])) for index in window.dense]
        return replace(prediction, features=np.stack([features for _, features in self._known]))

    def _features(self, frame: Frame) -> np.ndarray:
        for known, features in self._known:
            is_same = known.image is frame.image or np.array_equal(known.image, frame.image)
            if known.name == frame.name and is_same:
                return features
        return self._model.extract(frame)


class Requeried(Wrapped):
    """A prior with features of a model, compared with the text embeddings of a file of `experiments.embed`."""

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
    """A prior without points under `Frame.mask`."""

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

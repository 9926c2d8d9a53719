"""The `simulated` prior: true depth and poses, disturbed as a feed-forward model errs (docs/simulated.md has a table).

- *Poses.* The window's pose error, multiplied from the right, turns the window about the middle of `views[1:]`. From
  there each neighbour outward follows by the disturbed relative pose of its pair, `T_a_b · exp(noise)` with a before b.
- *Anchor.* The pose of view 0 is the identity. The window's pose error stands between it and all other views, also in
  the first window, where the anchor is one of the FIFO's images. Its depth is disturbed like any other.
- *Scale* multiplies every point and every translation of the inference.
- *Depth.* First flying points, then smooth warps and pixel noise on the log depth: a point stays on its pixel's ray.

Every generator is seeded by (seed, stream, inference, frames), and processes over inferences are sums of the start of
one stream. So one inference alone gives the same bits as a whole run. In a run of a part of a walk, what belongs to the
images is drawn by their numbers in the walk, so that it is that of the whole; inferences have draws of their own.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from emgs_jax.data.backprojection import backproject
from emgs_jax.data.base import Dataset, Frame
from emgs_jax.features.text import random_embeddings
from emgs_jax.prior.base import DenseView, Prior, PriorPrediction, Provenance, Window, predicted
from emgs_jax.prior.simulated.noise import (
    Stream,
    autoregressive,
    confused,
    edge_band,
    normals,
    random_walk,
    rigid,
    shared_normals,
    smooth_field,
)
from emgs_jax.prior.simulated.truth import check_frames, no_truth, shared_points

VERSIONS = (1, 2)
REVISITS = 2**24  # more than any sequence has inferences
WALKS = 2**48  # more than there are draws or seeds
MAX_LEVEL = 100.0  # depths are then off by a factor of twenty


@dataclass(frozen=True)
class Standard:
    """The disturbances at level 1: standard deviations in metres, radians and log depth; lengths in pixels."""

    scale: float = 0.03
    window_translation: float = 0.015
    window_rotation: float = math.radians(0.5)
    autocorrelation: float = 0.9  # of scale and window pose, from one inference to the next
    min_shared: float = 0.05  # version 2: share of points of anchor and middle view for the anchor to hold the window
    shared_tolerance: float = 0.05  # relative depth difference of one point
    shared_columns: int = 80  # points across the image
    unheld_translation: float = 0.1  # of the distance between anchor and middle camera
    unheld_rotation: float = math.radians(5.0)
    scale_walk: float = 0.003  # version 2: step of the log-scale from one inference to the next
    pair_translation: float = 0.01
    pair_rotation: float = math.radians(0.3)
    image_share: float = 0.7  # of the variance of walk and warp; the rest belongs to the inference
    warp: tuple[float, ...] = (0.03, 0.01)
    warp_length: tuple[float, ...] = (64.0, 16.0)  # correlation exp(-r²/2ℓ²), at an image width of `reference_width`
    reference_width: float = 640.0
    pixel: float = 0.01
    edge_step: float = 0.05  # relative depth difference between neighbouring pixels
    flying_share: float = 0.5  # of the pixels within 2 px of such a step
    max_confidence: float = 5.0
    confidence_error: float = 0.03  # log-depth error that divides the confidence's excess over 1 by e
    confidence_cap: float = 2.0  # times that error; a larger one does not lower the confidence
    confidence_edge: float = 1.5
    confidence_noise: float = 0.5
    feature_cosine: float = 0.8  # expected cosine of a feature and the embedding of its class


class Simulated(Prior):
    """A prior that disturbs the ground truth.

    Args:
        level: factor of all standard deviations; 0 gives the exact truth.
        feature_size: width f of the features.
        classes: names of the data set's labels; without them features have width 0.
        version: 1: the anchor holds every window, so nothing drifts; 2: only windows that share points with it.
        confusion: probability at level 1 that a class is taken for another.
        first: number of the run's first frame in the walk of which it is a part.
    """

    def __init__(
        self,
        level: float | int = 1.0,
        seed: int = 0,
        feature_size: int = 16,
        classes: Sequence[str] = (),
        version: int = 1,
        confusion: float | int = 0.0,
        first: int = 0,
    ) -> None:
        if version not in VERSIONS:
            raise ValueError(f"prior.version must be 1 (no drift) or 2 (drift beyond the anchor's view), got {version}")
        if not 0 <= level <= MAX_LEVEL:
            raise ValueError(f"prior.level must be from 0 (an exact prior) to {MAX_LEVEL:g}, got {level}")
        if not isinstance(seed, int) or not isinstance(feature_size, int) or seed < 0 or feature_size < 1:
            numbers = f"{seed} and {feature_size}"
            raise ValueError(f"prior.seed and prior.feature_size must be whole, from 0 and from 1, got {numbers}")
        if not 0 <= confusion <= 1:
            raise ValueError(f"prior.confusion is a probability, from 0 to 1, got {confusion}")
        self.level, self.seed, self.version, self.standard = float(level), int(seed), int(version), Standard()
        if not isinstance(first, int) or first < 0:
            raise ValueError(f"prior.first is the number of a frame, 0 or more, got {first}")
        self.confusion, self.first = float(confusion), first
        self.feature_names = tuple(classes)
        self.text_features = random_embeddings(self.feature_names, feature_size)
        settings = {"version": self.version, "level": self.level, "seed": self.seed}
        settings |= {"feature_size": self.text_features.shape[1]} | ({"confusion": self.confusion} if confusion else {})
        settings |= {"first": first} if first else {}
        name = "simulated" if self.version == 1 else f"simulated v{self.version}"
        self.provenance = Provenance(name, settings, is_simulated=True)

    def check(self, dataset: Dataset, window_size: int) -> None:
        """Raise ValueError if the data set has no truth to disturb."""
        if not dataset.has_ground_truth:
            raise ValueError(no_truth(f"{dataset.name} {dataset.sequence} has none"))
        missing = [index for index in range(len(dataset)) if dataset.pose(index) is None]
        if missing:
            raise ValueError(
                f"prior=simulated needs the true pose of every frame, and {len(missing)} of {len(dataset)} of "
                f"{dataset.name} {dataset.sequence} have none, the first is frame {missing[0]}: choose others "
                "(dataset.start, stop, stride), or another prior"
            )

    def predict(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        return self._answer(window, frames, intrinsics, window.inference)

    def revisit(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        """Likewise with other noise than the step of the same number."""
        return self._answer(window, frames, intrinsics, REVISITS * (1 + window.views[0]) + window.inference)

    def _answer(
        self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float], draw: int
    ) -> PriorPrediction:
        """Predict with noise number `draw`; scale and window pose are processes over inferences."""
        compared = () if self.version == 1 else (window.views[0], window.views[_middle(window)])
        by_index = check_frames(window, frames, {*window.dense, *compared})
        of_run = WALKS * self.first
        draw += of_run
        drift = autoregressive(self.seed + of_run, window.inference, self.standard.autocorrelation, 7)
        scale = math.exp(self.level * self.standard.scale * drift[0])
        if self.version == 2:
            scale *= math.exp(self.level * self.standard.scale_walk * random_walk(self.seed + of_run, window.inference))
        is_held = self.version == 1 or self._is_held(frames[0], frames[_middle(window)], intrinsics)
        T_anchor_view = self._poses(window, [frame.T_world_camera for frame in frames], drift[1:], is_held, draw)
        T_anchor_view[:, :3, 3] *= scale
        views = [self._geometry(draw, by_index[index], intrinsics, scale) for index in window.dense]
        features = np.stack([self._features(draw, by_index[index]) for index in window.dense])
        return predicted(window, T_anchor_view, views, features)

    def _is_held(self, anchor: Frame, middle: Frame, intrinsics: Sequence[float]) -> bool:
        """Test whether the anchor shares enough points with the window's middle view."""
        noise = self.standard
        shared = shared_points(anchor, middle, intrinsics, noise.shared_tolerance, noise.shared_columns)
        return shared >= noise.min_shared

    def _poses(
        self, window: Window, truth: Sequence[np.ndarray], drift: np.ndarray, is_held: bool, draw: int
    ) -> np.ndarray:
        """The disturbed camera -> anchor poses (v, 4, 4) before the scale; `drift` (6,) is the window's pose error."""
        noise, views = self.standard, window.views
        T_true = np.linalg.inv(np.asarray(truth[0], np.float64)) @ np.asarray(truth, np.float64)
        T_out = np.tile(np.eye(4), (len(views), 1, 1))
        if len(views) == 1:
            return T_out
        middle, distance = _middle(window), np.linalg.norm(T_true[_middle(window), :3, 3])
        reach = self.level * (1 + distance)
        translation, rotation = reach * noise.window_translation, reach * noise.window_rotation
        if not is_held:
            translation = max(translation, self.level * noise.unheld_translation * distance)
            rotation = max(rotation, self.level * noise.unheld_rotation)
        T_out[middle] = T_true[middle] @ rigid(drift, translation, rotation)
        for left in range(middle, len(views) - 1):
            T_out[left + 1] = T_out[left] @ self._pair(window, left, T_true, draw)
        for left in range(middle - 1, 0, -1):
            T_out[left] = T_out[left + 1] @ np.linalg.inv(self._pair(window, left, T_true, draw))
        return T_out

    def _pair(self, window: Window, left: int, T_true: np.ndarray, draw: int) -> np.ndarray:
        """The disturbed relative pose (4, 4) of the views `left` and `left + 1`."""
        noise, pair = self.standard, [self.first + index for index in window.views[left : left + 2]]
        xi = shared_normals((6,), (self.seed, Stream.PAIR, draw, *pair), noise.image_share)
        T_left_right = np.linalg.inv(T_true[left]) @ T_true[left + 1]
        return T_left_right @ rigid(xi, self.level * noise.pair_translation, self.level * noise.pair_rotation)

    def _geometry(self, inference: int, frame: Frame, intrinsics: Sequence[float], scale: float) -> DenseView:
        depth = np.where(np.isfinite(frame.depth) & (frame.depth > 0), frame.depth, 0).astype(np.float32)
        mask = depth > 0
        index = self.first + frame.index
        flown, near_edge = self._flying(inference, index, depth)
        log_change = self.level * self._log_noise(inference, index, depth.shape)
        ratio = np.divide(flown, depth, out=np.ones_like(depth), where=mask)
        confidence = self._confidence(inference, index, np.abs(np.log(ratio) + log_change), near_edge)
        disturbed = flown.astype(np.float64) * np.exp(log_change) * scale
        return backproject(disturbed, intrinsics).astype(np.float32), confidence, mask

    def _log_noise(self, inference: int, index: int, shape: tuple[int, int]) -> np.ndarray:
        """Warp plus pixel noise of the log depth at level 1, float32 (h, w)."""
        noise = self.standard
        total = noise.pixel * normals(shape, (self.seed, Stream.PIXEL, inference, index))
        for number, (sigma, length) in enumerate(zip(noise.warp, noise.warp_length, strict=True)):
            key = (self.seed, Stream.WARP + number, inference, index)
            total += sigma * smooth_field(shape, length * shape[1] / noise.reference_width, key, noise.image_share)
        return total

    def _flying(self, inference: int, index: int, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The depth with flying points and the mask of the pixels within 2 px of a depth step, both (h, w)."""
        near_edge = edge_band(depth, self.standard.edge_step)
        window = np.ones((5, 5), np.uint8)
        low = -cv2.dilate(np.where(depth > 0, -depth, -np.inf).astype(np.float32), window)
        high = cv2.dilate(depth, window)
        rng = np.random.default_rng((self.seed, Stream.FLYING, inference, index))
        chance, between = rng.random((2, *depth.shape), np.float32)
        flies = near_edge & (chance < self.standard.flying_share * min(1.0, self.level))
        low = np.where(flies, low, 0)  # infinite where no pixel is valid
        return np.where(flies, low + between * (high - low), depth), near_edge

    def _confidence(self, inference: int, index: int, error: np.ndarray, near_edge: np.ndarray) -> np.ndarray:
        """The confidence (h, w) ≥ 1 for the absolute log-depth `error` without the common scale."""
        noise = self.standard
        # The jitter does not grow above level 1, where it would hide all errors.
        jitter = normals(error.shape, (self.seed, Stream.CONFIDENCE, inference, index))
        jitter *= min(1.0, self.level) * noise.confidence_noise
        doubt = np.minimum(error / noise.confidence_error, noise.confidence_cap) + noise.confidence_edge * near_edge
        return (1 + (noise.max_confidence - 1) * np.exp(jitter - doubt)).astype(np.float32)

    def _features(self, inference: int, frame: Frame) -> np.ndarray:
        """The noisy unit text embedding of each pixel's label, float16 (h, w, f); zero without a label."""
        shape, (num_classes, size) = frame.depth.shape, self.text_features.shape
        if frame.labels is None or size == 0:
            return np.zeros((*shape, size), np.float16)
        if frame.labels.max() >= num_classes:
            label = f"label {frame.labels.max()} of {num_classes} classes"
            raise ValueError(f"frame {frame.index} ({frame.name}) has {label}")
        # The cosine of e and e + n is 1 / sqrt(1 + |n|²) in expectation, and |n|² = sigma² f.
        sigma = self.level * math.sqrt((self.standard.feature_cosine**-2 - 1) / size)
        share = min(1.0, self.level * self.confusion)
        features = self.text_features[confused(frame.labels, frame.T_world_camera, num_classes, share, self.seed)]
        if sigma > 0:
            features += sigma * normals(
                features.shape, (self.seed, Stream.FEATURE, inference, self.first + frame.index)
            )
            features /= np.maximum(np.linalg.norm(features, axis=-1, keepdims=True), 1e-12)
        features[frame.labels < 0] = 0
        return features.astype(np.float16)


def _middle(window: Window) -> int:
    """Index in `window.views` of the middle of the views after the anchor; 0 for a single view."""
    return min(1 + (len(window.views) - 1) // 2, len(window.views) - 1)

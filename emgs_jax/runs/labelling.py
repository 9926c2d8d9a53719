"""Classify surface points: the Gaussians that explain a point vote by their responsibilities."""

from dataclasses import dataclass
from functools import cached_property

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from emgs_jax.device.arrays import on_device
from emgs_jax.evaluation.clouds import NearestPoints
from emgs_jax.evaluation.segmentation import LabelledPoints
from emgs_jax.gaussian_map import confirmed
from emgs_jax.mapping.run import MappingRun
from emgs_jax.prior.base import Prior
from emgs_jax.semantics import classify, similarities

NUM_NEIGHBOURS = 8  # Gaussians that may explain a point
MAX_POINTS = 10_000  # at once, to bound the memory; does not change the result
_classify, _similarities = eqx.filter_jit(classify), eqx.filter_jit(similarities)


@dataclass(frozen=True)
class LabelledMap:
    """Gaussians with their evidence for classes."""

    means: np.ndarray  # (n, 3), m
    whiten: np.ndarray  # (n, 3, 3), inverse of the Cholesky factors of the covariances
    log_dets: np.ndarray  # (n,), of the covariances
    # (n, c), the feature's projection on the text of each class. Features are sums over the points of all views (R16),
    # so its size says how much is known.
    evidence: np.ndarray
    classes: tuple[str, ...]

    @cached_property
    def labels(self) -> Int[np.ndarray, "n"]:
        """The class of each Gaussian alone, a position in `classes`."""
        return self.evidence.argmax(1)

    @cached_property
    def nearest(self) -> NearestPoints:
        """Search tree of the means."""
        return NearestPoints(self.means)

    @property
    def centers(self) -> LabelledPoints:
        """The means, with their classes."""
        return LabelledPoints(self.means, self.labels, self.classes)

    def classes_of(self, points: Float[np.ndarray, "m 3"]) -> Int[np.ndarray, "m"]:
        """Find the class with most evidence at each point: argmax_c Σ_k r_k e_kc; -1 without Gaussians.

        r_k is the responsibility (eq. 3, by position alone) of one of the Gaussians with the nearest means, as in the
        E-step. A flat Gaussian of a wall does not explain a cup near its mean, and one that was seen once does not
        outvote its neighbours that were seen from all sides.
        """
        if not len(self.means):
            return np.full(len(points), -1)
        rows = self.nearest.query(points, NUM_NEIGHBOURS)[1]
        votes = self.labels[rows]
        classes = votes[:, 0].copy()
        # If all neighbours share a class, take it; the other points are few, so their memory is bounded.
        is_open = np.flatnonzero((votes != votes[:, :1]).any(1))
        for part in np.array_split(is_open, -(-len(is_open) // MAX_POINTS)) if len(is_open) else ():
            classes[part] = self._elected(points[part], rows[part])
        return classes

    def _elected(self, points: Float[np.ndarray, "m 3"], rows: Int[np.ndarray, "m k"]) -> Int[np.ndarray, "m"]:
        white = np.matvec(self.whiten[rows], points[:, None] - self.means[rows])
        log_density = -0.5 * ((white**2).sum(-1) + self.log_dets[rows])
        responsibility = np.exp(log_density - log_density.max(1, keepdims=True))  # its sum over k changes no argmax
        return np.vecmat(responsibility, self.evidence[rows]).argmax(1)


def labelled_map(run: MappingRun, prior: Prior) -> LabelledMap | None:
    """Project the features of confirmed Gaussians on each class's text; None without classes."""
    gaussians = confirmed(run.state.map)
    if not prior.feature_names or not gaussians.features.shape[-1]:
        return None
    text = on_device(np.asarray(prior.text_features, np.float32))
    rows, labels, cosines = jax.device_get((gaussians, _classify(gaussians, text), _similarities(gaussians, text)))
    known = labels >= 0
    factors = np.linalg.cholesky(rows.covs[known].astype(np.float64))
    return LabelledMap(
        means=rows.means[known].astype(np.float64),
        whiten=np.linalg.inv(factors),
        log_dets=2.0 * np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(-1),
        evidence=cosines[known] * np.linalg.norm(rows.features[known], axis=-1, keepdims=True),
        classes=tuple(prior.feature_names),
    )

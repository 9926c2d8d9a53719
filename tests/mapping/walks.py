"""Frames of a path in any order, priors that lose their way, and runs over them; the prior is exact where it knows."""

import itertools
from dataclasses import replace
from functools import cache

import jax
import numpy as np
from loop_scene import matrix
from omegaconf import OmegaConf
from scene import assert_same
from tiny_run import SMOKE

from emgs_jax import load_config
from emgs_jax.config.configure import build_dataset, build_prior
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.mapping.pipeline import finish_run, map_frames
from emgs_jax.mapping.run import MappingRun, new_run
from emgs_jax.prior.base import Prior, PriorPrediction

WORDS = (*SMOKE, "dataset.num_frames=80", "dataset.stop=80", "prior.level=0", "graph=default")
THERE, BACK = range(0, 24, 2), (7, 9, 11, 13, 15)  # frames of the path: what is mapped, and views between these
NEVER_FOUND = "graph.relocalization.min_inliers=100000"


@cache
def config(*words: str):
    return load_config(*WORDS, *words)


@cache
def settings(*words: str):
    return OmegaConf.create(config(*words).settings)


def walk(numbers, *words: str) -> ReadableFrames:
    """Frames of the path in any order."""
    frames = ReadableFrames(build_dataset(settings(*words))._dataset)
    frames.kept = [*numbers]
    return frames


def prior_of(frames: ReadableFrames, *words: str) -> Prior:
    return build_prior(settings(*words), frames)


class Edited(Prior):
    """A prior whose answers pass through `_edit`."""

    def __init__(self, prior: Prior) -> None:
        self._prior, self.provenance = prior, prior.provenance
        self.feature_names, self.text_features = prior.feature_names, prior.text_features

    def predict(self, window, frames, intrinsics) -> PriorPrediction:
        return self._edit(self._prior.predict(window, frames, intrinsics))


class Blinded(Edited):
    """A prior that is in another world from one frame on, and knows there of the frames before where the first is."""

    def __init__(self, prior: Prior, cut: int) -> None:
        super().__init__(prior)
        self._cut = cut

    def _edit(self, found: PriorPrediction) -> PriorPrediction:
        window = found.window
        if window.current < self._cut:
            return found
        poses, mask = matrix((20, 60, 10), (4.0, 1.0, -3.0)) @ found.T_anchor_view, found.mask.copy()
        poses[[0 < view < self._cut for view in window.views]] = np.nan
        poses[0] = np.eye(4)
        mask[[view < self._cut for view in window.dense]] = False
        return replace(found, T_anchor_view=poses, mask=mask)


class Misled(Edited):
    """A prior that errs by one motion, always the same, between all frames before a cut and all from it on."""

    motion = matrix((0, 40, 0), (0.0, 0.0, 1.5))

    def __init__(self, prior: Prior, cut: int) -> None:
        super().__init__(prior)
        self._cut = cut

    def _edit(self, found: PriorPrediction) -> PriorPrediction:
        poses = found.T_anchor_view.copy()
        later = [view >= self._cut for view in found.window.views]
        poses[later] = self.motion @ poses[later]
        return replace(found, T_anchor_view=poses)


class Apart(Edited):
    """A prior with a frame and a unit of its own in each part, that knows nothing there of the other parts.

    Args:
        prior: of the whole.
        units: of the parts: what is given there as that is a metre.
        starts: the first frames of all parts but the first.
        is_silent: nothing at all is known from the first of these on.
    """

    def __init__(self, prior: Prior, starts, units, is_silent: bool = False) -> None:
        super().__init__(prior)
        self._starts, self._units, self._is_silent = starts, units, is_silent

    def _part(self, frame: int) -> int:
        return sum(frame >= start for start in self._starts)

    def _edit(self, found: PriorPrediction) -> PriorPrediction:
        window, part = found.window, self._part(found.window.current)
        poses, mask, points = found.T_anchor_view.copy(), found.mask.copy(), found.points
        if part > 0:
            poses, points = (
                matrix((20, 60, 10 * part), (4.0, part, -3.0)) @ poses,
                np.float32(self._units[part]) * points,
            )
            poses[:, :3, 3] *= self._units[part]
        poses[[self._part(view) != part for view in window.views]] = np.nan
        mask[[self._part(view) != part for view in window.dense]] = False
        if part > 0 and self._is_silent:
            poses[:], mask[:], points = np.nan, False, 0 * points
        return replace(found, T_anchor_view=poses, mask=mask, points=points)


class Visited(Apart):
    """The same, that numbers its worlds: the parts are in the first and the second in turn."""

    def _part(self, frame: int) -> int:
        return super()._part(frame) % 2

    def _edit(self, found: PriorPrediction) -> PriorPrediction:
        return replace(super()._edit(found), world=self._part(found.window.current))


def mapped(
    frames: ReadableFrames, prior: Prior, saved=None, keeper=None, stop: int | None = None, words=()
) -> MappingRun:
    """A run; one that is stopped after so many frames leaves its checkpoint."""
    start = new_run(frames, config(*words).slam, graph=config(*words).graph, saved=saved)
    *_, (run, _, _) = itertools.islice(map_frames(start, frames, prior, keeper), stop)
    if stop is not None:
        keeper.save()
    return finish_run(run, is_interrupted=stop is not None)


def same_run(one: MappingRun, other: MappingRun) -> None:
    """Map, poses and what the back end knows, to the bit."""
    assert_same(jax.device_get(one.state), jax.device_get(other.state))
    np.testing.assert_array_equal(one.poses, other.poses)
    np.testing.assert_array_equal(one.back_end.poses, other.back_end.poses)
    assert [node.submap for node in one.back_end.nodes] == [node.submap for node in other.back_end.nodes]
    for name in ("location", "status"):
        assert [getattr(record, name) for record in one.records] == [getattr(record, name) for record in other.records]

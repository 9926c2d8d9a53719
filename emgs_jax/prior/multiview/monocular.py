"""Depth of a monocular or video network, fitted to the landmarks of a structure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from emgs_jax.ops.ranges import number, one_of
from emgs_jax.prior.multiview.dense import DenseConfig, Depth, Depths, Scene, tried_depths
from emgs_jax.prior.multiview.depth_noise import DepthNoiseConfig
from emgs_jax.prior.multiview.landmark_fit import KINDS, LandmarkFit, LandmarkFitConfig, fit_to_landmarks, to_depth
from emgs_jax.prior.multiview.landmarks import Landmarks, landmarks_of, point_information
from emgs_jax.scale.estimate import Scale
from emgs_jax.scale.network import cells_of, log_ratio, scale_of_network
from emgs_jax.structure.model import Structure


@dataclass(frozen=True, kw_only=True)
class MonocularConfig(DenseConfig):
    """Depth that is fitted to landmarks."""

    # Nothing is matched; the spread is that of the landmark fit.
    noise: DepthNoiseConfig = field(
        default_factory=partial(DepthNoiseConfig, pixel_std=0.0, spread_std=1.0, difference_std=1.0, max_std=0.2)
    )
    fit: LandmarkFitConfig = field(default_factory=LandmarkFitConfig)  # scale and shift of each frame
    # `metric`: depths in metres, whose scale enters that of the structure; `up_to_scale`; `affine`: up to scale and
    # shift; `affine_inverse`: likewise of 1/z.
    kind: str = one_of(*KINDS)
    depth_margin: float = number(2.0, low=1, high=1000)
    cell: float = number(0.1, low=1e-3, high=1)  # share of the image's longer side within which a network errs alike
    pixel_std: float = number(1.0, low=1e-3, high=100)  # of a landmark, in pixels of the structure's images
    # Of the log of the scale of metric depths, from scene to scene: what more frames do not average out. A network that
    # has not seen a place before errs by .1 to .3 of its depths (docs/metres.md).
    metric_std: float = number(0.2, low=1e-3, high=10)


def begin_monocular(
    scene: Scene, values: Callable[[int], Float[np.ndarray, "h w"]], config: MonocularConfig
) -> tuple[Depths, Sequence[Scale | None]]:
    """Return the depth of each frame in the structure's unit, and the scale of each world if the network's are metric.

    `values` maps a frame to the network's values at the pinhole camera's pixels, NaN = none. Raises as
    `fit_to_landmarks`.
    """
    found, fits, scales, rows = scene.newest(), [], [], {}
    for world in range(len(found.worlds)):
        frames = np.flatnonzero((found.world == world) & found.is_placed)
        rows |= {int(frame): row for row, frame in enumerate(frames)}
        landmarks, said = _said(scene, world, frames, values, config)
        fits.append(_fit(frames, landmarks, said, config))
        if config.kind == "metric":
            scales.append(_scale(scene, frames, landmarks, said, config))
    ranges = [tried_depths(_depths(found, world), config.depth_margin) for world in range(len(found.worlds))]

    def depth_of(frame: int) -> Depth:
        world = found.world[frame]
        depth, std = to_depth(values(frame), fits[world], rows[frame])
        near, far = ranges[world]
        is_near = (depth >= near) & (depth <= far)
        scale_std = float(np.sqrt(fits[world].covariance[rows[frame], 0, 0]))
        return Depth(np.where(is_near, depth, 0.0), std, np.float32(is_near), scale_std)

    return depth_of, scales


def _depths(found: Structure, world: int) -> np.ndarray:
    z = np.concatenate([found.depths(frame) for frame in np.flatnonzero(found.world == world)])
    return z[z > 0]


def _said(
    scene: Scene, world: int, frames: np.ndarray, values: Callable[[int], np.ndarray], config: MonocularConfig
) -> tuple[list[Landmarks], list[np.ndarray]]:
    """The landmarks of a world's frames, and the network's values at them."""
    structure = scene.newest()
    information = point_information(structure, world, config.pixel_std)
    landmarks = [landmarks_of(structure, frame, information, scene.camera, config.cell) for frame in frames]
    said = []
    for frame, found in zip(frames, landmarks, strict=True):
        column, row = np.rint(found.pixels).astype(int).T
        said.append(values(int(frame))[row, column])
    return landmarks, said


def _fit(
    frames: np.ndarray, landmarks: Sequence[Landmarks], said: Sequence[np.ndarray], config: MonocularConfig
) -> LandmarkFit:
    """Fit scale and shift of a world's frames, and report the fit."""
    fit = fit_to_landmarks(said, landmarks, frames, config.kind, config.fit)
    log_scale = fit.parameters[:, 0] - fit.parameters[:, 0].mean()
    tqdm.write(
        f"prior.dense: {config.kind} depths of {len(frames)} frames on {np.median([len(s) for s in said]):.0f} "
        f"landmarks each: they differ by {100 * np.median(fit.std):.1f} %, scale from {np.exp(log_scale.min()):.3f} to "
        f"{np.exp(log_scale.max()):.3f}, {100 * fit.step_std[0]:.2f} % from frame to frame"
    )
    return fit


def _scale(
    scene: Scene,
    frames: np.ndarray,
    landmarks: Sequence[Landmarks],
    said: Sequence[np.ndarray],
    config: MonocularConfig,
) -> Scale | None:
    """Metres of a world's unit by depths in metres, which err alike within a cell at the landmarks' median depth."""
    ratios = [
        log_ratio(metres, found.depth, found.weight, config.fit.min_landmarks)
        for metres, found in zip(said, landmarks, strict=True)
    ]
    camera, structure = scene.camera, scene.newest()
    depth = float(np.median(np.concatenate([found.depth for found in landmarks])))
    side = config.cell * max(camera.width, camera.height) / float(np.mean(camera.focal)) * depth
    shown = [cells_of(structure.shown(int(frame)), side) for frame in frames]
    return scale_of_network(np.array(ratios), shown, config.metric_std)

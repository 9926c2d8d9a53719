"""Planes where texture is missing: a blank region of the image is one plane if the matches on it say so.

Matching costs of a blank wall are flat, and what semi-global aggregation makes of it is a depth that is extended from
its border, parallel to the image. But blank regions of rooms are mostly planes, and their borders match well. So each
blank region gets the plane on which most of its confident matches lie, if these are enough of them (planar priors:
Gallup, Frahm and Pollefeys, "Piecewise planar and non-planar stereo", CVPR 2010; Xu and Tao, "Planar prior assisted
PatchMatch multi-view stereo", AAAI 2020). The inverse depth of a plane is linear in the pixel, 1/z = p · (u, v, 1), so
it is found by RANSAC (Fischler and Bolles, CACM 1981) and least squares, and is as certain as their prediction.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from emgs_jax.ops.ranges import number


@dataclass(frozen=True)
class PlanarConfig:
    """Detection of blank regions of an image that become planes."""

    # grey value range, image in [0, 1], of the surroundings of a pixel that is blank
    max_contrast: float = number(0.03, low=0, high=1)
    radius: int = number(1, low=1, high=64)  # pixels; half the side of these surroundings
    min_area: int = number(400, low=1)  # pixels of a region
    max_spread: float = number(1.2, low=0)  # planes of the sweep; matches that are less certain support nothing
    min_matches: int = number(50, low=3)  # of a region
    tolerance: float = number(1.0, low=0)  # planes of the sweep; matches so near to a plane support it
    min_share: float = number(0.75, low=0, high=1)  # of a region's matches that must support its plane
    num_draws: int = number(64, low=1, high=1e6)  # planes through three matches that are tried
    correlation: float = number(5.0, low=0)  # pixels; errors of matches that are nearer to each other are the same


def blank_regions(gray: Float[np.ndarray, "h w"], config: PlanarConfig) -> Iterator[Bool[np.ndarray, "h w"]]:
    """The connected regions without texture, each with the surroundings in which its pixels have none."""
    around = np.ones((2 * config.radius + 1,) * 2, np.uint8)
    is_blank = cv2.dilate(gray, around) - cv2.erode(gray, around) < config.max_contrast
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(is_blank.astype(np.uint8), connectivity=4)
    for label in range(1, count):
        if statistics[label, cv2.CC_STAT_AREA] >= config.min_area:
            yield cv2.dilate((labels == label).astype(np.uint8), around) > 0


def fit_plane(
    pixels: Float[np.ndarray, "n 3"], inverse: Float[np.ndarray, "n"], config: PlanarConfig
) -> tuple[Float[np.ndarray, "3"], Bool[np.ndarray, "n"]]:
    """The plane on which most matches lie, and which these are.

    Args:
        pixels: (u, v, 1) of the matches.
        inverse: their inverse depths, in planes of the sweep.
    """
    draws = np.random.default_rng(0).integers(len(pixels), size=(config.num_draws, 3))
    planes = np.einsum("dij,dj->di", np.linalg.pinv(pixels[draws]), inverse[draws])
    on_plane = np.abs(planes @ pixels.T - inverse) <= config.tolerance
    chosen = on_plane[on_plane.sum(axis=1).argmax()]
    for _ in range(2):  # least squares of those that support it, then of those that support that
        plane = np.linalg.lstsq(pixels[chosen], inverse[chosen])[0]
        chosen = np.abs(pixels @ plane - inverse) <= config.tolerance
    return plane, chosen


def _prediction_std(
    at: Float[np.ndarray, "m 3"], pixels: Float[np.ndarray, "n 3"], errors: Float[np.ndarray, "n"], config: PlanarConfig
) -> Float[np.ndarray, "m"]:
    """Standard deviation, in planes of the sweep, of a fitted plane at other pixels: σ² (1 + xᵀ (XᵀX / c²)⁻¹ x).

    c² matches, the square of the correlation length, count as one. Inf where the matches lie on a line.
    """
    variance, hessian = np.mean(errors**2), pixels.T @ pixels / config.correlation**2
    if np.linalg.cond(hessian) > 1e9:
        return np.full(len(at), np.inf)
    return np.sqrt(variance * (1.0 + np.einsum("mi,ij,mj->m", at, np.linalg.inv(hessian), at)))


def fill_planes(
    depth: Float[np.ndarray, "h w"],
    spread: Float[np.ndarray, "h w"],
    gray: Float[np.ndarray, "h w"],
    spacing: float,
    config: PlanarConfig,
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Depth (m) and spread, with those of a blank region's plane where that is the more certain one.

    Args:
        depth: m, 0 where it is not known.
        spread: its uncertainty in planes of the sweep.
        gray: the image, in [0, 1].
        spacing: 1/m between the planes of the sweep.
    """
    height, width = depth.shape
    v, u = np.mgrid[:height, :width]
    pixels = np.stack([u / width - 0.5, v / width - 0.5, np.ones_like(depth)], axis=-1)
    is_match = (depth > 0) & (spread <= config.max_spread)
    inverse = 1.0 / (spacing * np.where(depth > 0, depth, np.inf))
    filled, certain = inverse.copy(), np.where(depth > 0, spread, np.inf)
    for region in blank_regions(gray, config):
        near = is_match & region
        if near.sum() < config.min_matches:
            continue
        plane, chosen = fit_plane(pixels[near], inverse[near], config)
        if chosen.mean() < config.min_share:
            continue
        found, errors = pixels[region] @ plane, (pixels[near] @ plane - inverse[near])[chosen]
        std = _prediction_std(pixels[region], pixels[near][chosen], errors, config)
        better = (std < certain[region]) & (found > 0)
        filled[region] = np.where(better, found, filled[region])
        certain[region] = np.where(better, std, certain[region])
    known = filled > 0
    return np.where(known, 1.0 / (spacing * np.where(known, filled, 1.0)), 0.0), np.where(known, certain, spread)

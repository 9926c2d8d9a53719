"""Fit planes to regions without texture.

On a blank wall the matching costs are flat, and semi-global aggregation extends the depth of its border parallel to the
image. But blank regions of rooms are mostly planes with well matched borders, so each gets the plane of most of its
confident matches, if these are enough, or a few planes (planar priors: Gallup, Frahm and Pollefeys, CVPR 2010; Xu and
Tao, AAAI 2020). A plane's inverse depth is linear in the pixel, 1/z = p · (u, v, 1): RANSAC and least squares find it,
and its uncertainty is that of their prediction.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from emgs_jax.ops.ranges import number

MAX_PLANES = 4  # of a region


@dataclass(frozen=True)
class PlanarConfig:
    """Detection of blank regions that become planes."""

    max_contrast: float = number(0.03, low=0, high=1)  # range of grey values in [0, 1] around a blank pixel
    radius: int = number(1, low=1, high=64)  # of these surroundings, pixels
    min_area: int = number(400, low=1)  # of a region, pixels
    max_spread: float = number(1.2, low=0)  # of a match, in planes of the sweep
    min_matches: int = number(50, low=3)  # of a region, and of each of its planes
    tolerance: float = number(1.0, low=0)  # distance of a supporting match from the plane, in planes of the sweep
    min_share: float = number(0.75, low=0, high=1)  # of a region's matches that must support its planes
    num_draws: int = number(64, low=1, high=1e6)  # of three matches, by RANSAC
    correlation: float = number(5.0, low=0)  # length over which matches err alike, pixels


def blank_regions(gray: Float[np.ndarray, "h w"], config: PlanarConfig) -> Iterator[Bool[np.ndarray, "h w"]]:
    """The connected regions without texture, each dilated by its pixels' surroundings."""
    around = np.ones((2 * config.radius + 1,) * 2, np.uint8)
    is_blank = cv2.dilate(gray, around) - cv2.erode(gray, around) < config.max_contrast
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(is_blank.astype(np.uint8), connectivity=4)
    for label in range(1, count):
        if statistics[label, cv2.CC_STAT_AREA] >= config.min_area:
            yield cv2.dilate((labels == label).astype(np.uint8), around) > 0


def fit_plane(
    pixels: Float[np.ndarray, "n 3"], inverse: Float[np.ndarray, "n"], config: PlanarConfig
) -> tuple[Float[np.ndarray, "3"], Bool[np.ndarray, "n"]]:
    """Find the plane of most matches at `pixels` (u, v, 1) with inverse depths `inverse`, and these matches."""
    draws = np.random.default_rng(0).integers(len(pixels), size=(config.num_draws, 3))
    planes = np.einsum("dij,dj->di", np.linalg.pinv(pixels[draws]), inverse[draws])
    on_plane = np.abs(planes @ pixels.T - inverse) <= config.tolerance
    chosen = on_plane[on_plane.sum(axis=1).argmax()]
    for _ in range(2):  # least squares of its supporters, then of the supporters of that
        plane = np.linalg.lstsq(pixels[chosen], inverse[chosen])[0]
        chosen = np.abs(pixels @ plane - inverse) <= config.tolerance
    return plane, chosen


def _prediction_std(
    at: Float[np.ndarray, "m 3"], pixels: Float[np.ndarray, "n 3"], errors: Float[np.ndarray, "n"], config: PlanarConfig
) -> Float[np.ndarray, "m"]:
    """Standard deviation of a fitted plane at other pixels, by the variance σ² (1 + xᵀ (XᵀX / c²)⁻¹ x).

    c² matches, the square of the correlation length, count as one. Inf if the matches lie on a line.
    """
    variance, hessian = np.mean(errors**2), pixels.T @ pixels / config.correlation**2
    if np.linalg.cond(hessian) > 1e9:
        return np.full(len(at), np.inf)
    return np.sqrt(variance * (1.0 + np.einsum("mi,ij,mj->m", at, np.linalg.inv(hessian), at)))


def fit_planes(
    pixels: Float[np.ndarray, "n 3"], inverse: Float[np.ndarray, "n"], config: PlanarConfig
) -> list[tuple[Float[np.ndarray, "3"], Bool[np.ndarray, "n"]]]:
    """Find the planes of a region's matches, and the matches of each; none if they lie on no planes.

    The first plane has most of the matches. If it has less than `min_share` of them (a ceiling and its beam, two walls
    of one paint), the next one has most of those that are left, until together they have that share.
    """
    found, is_left = [], np.ones(len(pixels), bool)
    while len(found) < MAX_PLANES and is_left.sum() >= config.min_matches:
        plane, chosen = fit_plane(pixels[is_left], inverse[is_left], config)
        if chosen.sum() < config.min_matches:
            break
        of_plane = np.zeros(len(pixels), bool)
        of_plane[is_left] = chosen
        found, is_left = [*found, (plane, of_plane)], is_left & ~of_plane
        if np.mean(~is_left) >= config.min_share:
            return found
    return []


def _filled(
    region: Bool[np.ndarray, "h w"],
    near: Bool[np.ndarray, "h w"],
    pixels: Float[np.ndarray, "h w 3"],
    inverse: Float[np.ndarray, "h w"],
    config: PlanarConfig,
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]] | None:
    """Inverse depth and its standard deviation in a region, by the planes of its matches `near`; None without a plane.

    A pixel lies on the plane of the nearest match, most likely: where its nearest matches on plane k are d_k away, that
    plane has the probability p_k, proportional to 1 / d_k². The variance is that about the likeliest plane, so it is
    large between two planes that do not meet.
    """
    planes = fit_planes(pixels[near], inverse[near], config)
    if not planes:
        return None
    values, stds, distances = [], [], []
    for plane, chosen in planes:
        errors = (pixels[near] @ plane - inverse[near])[chosen]
        values.append(pixels[region] @ plane)
        stds.append(_prediction_std(pixels[region], pixels[near][chosen], errors, config))
        is_off = np.ones(region.shape, np.uint8)
        is_off[near] = ~chosen
        distances.append(cv2.distanceTransform(is_off, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[region])
    shares = np.maximum(distances, 0.5) ** -2.0  # pixels; a match is its own plane's for sure
    shares, nearest = shares / shares.sum(axis=0), np.argmin(distances, axis=0)
    found = np.take_along_axis(np.stack(values), nearest[None], axis=0)[0]
    return found, np.sqrt(np.sum(shares * (np.square(stds) + (values - found) ** 2), axis=0))


def fill_planes(
    depth: Float[np.ndarray, "h w"],
    spread: Float[np.ndarray, "h w"],
    gray: Float[np.ndarray, "h w"],
    spacing: float,
    config: PlanarConfig,
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Depth (0 where unknown) and spread, replaced by those of a blank region's planes where these are more certain.

    Spreads are in planes of the sweep, which are `spacing` (1/m) apart.
    """
    height, width = depth.shape
    v, u = np.mgrid[:height, :width]
    pixels = np.stack([u / width - 0.5, v / width - 0.5, np.ones_like(depth)], axis=-1)
    is_match = (depth > 0) & (spread <= config.max_spread)
    inverse = 1.0 / (spacing * np.where(depth > 0, depth, np.inf))
    filled, certain = inverse.copy(), np.where(depth > 0, spread, np.inf)
    for region in blank_regions(gray, config):
        near = is_match & region
        filled_in = _filled(region, near, pixels, inverse, config)
        if filled_in is None:
            continue
        found, std = filled_in
        better = (std < certain[region]) & (found > 0)
        filled[region] = np.where(better, found, filled[region])
        certain[region] = np.where(better, std, certain[region])
    known = filled > 0
    return np.where(known, 1.0 / (spacing * np.where(known, filled, 1.0)), 0.0), np.where(known, certain, spread)

"""Gaussians as viewers draw them: wide enough along the surface that it has no gaps."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from emgs_jax.gaussians import Gaussians

NUM_NEIGHBOURS = 6  # as many as touch a disc in a dense packing
REACH = 2.0  # standard deviations at which a neighbour may be: opacities of .9 then add up to .9 between them and more
CANDIDATES = 18  # nearest means, of which those that face another way are no neighbours
MIN_COSINE = 0.7  # between the normals of neighbours on one surface
LARGEST = 3.0  # times its width that a Gaussian becomes at most: one that stands alone stays a spot


def closing_covariances(means: np.ndarray, covs: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Covariances (n, 3, 3) that close the surface in an ordinary 3DGS rasteriser; for display only, float64.

    Each is widened along its surface until its sixth neighbour lies at `REACH` standard deviations, measured with its
    own covariance, so that it keeps its shape; none is narrowed, and the thickness along the unit normal stays.
    """
    means, covs, normals = (np.asarray(values, np.float64) for values in (means, covs, normals))
    if len(means) < 2:
        return covs
    rows = cKDTree(means).query(means, k=min(CANDIDATES + 1, len(means)))[1][:, 1:]
    plane = np.eye(3) - normals[:, :, None] * normals[:, None]
    offsets = (means[rows] - means[:, None]) @ plane
    distance_sq = np.einsum("nki,nij,nkj->nk", offsets, np.linalg.inv(covs), offsets)
    faces_alike = np.einsum("nki,ni->nk", normals[rows], normals) > MIN_COSINE
    distance_sq = np.sort(np.where(faces_alike, distance_sq, np.inf), axis=1)
    widening = np.clip(distance_sq[:, min(NUM_NEIGHBOURS, rows.shape[1]) - 1] / REACH**2, 1.0, LARGEST**2)
    return covs + (widening - 1.0)[:, None, None] * (plane @ covs @ plane)


def closed(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians with `closing_covariances`; for display only."""
    rows = np.flatnonzero(gaussians.valid)
    covs = np.array(gaussians.covs)
    covs[rows] = closing_covariances(*(np.asarray(x)[rows] for x in (gaussians.means, covs, gaussians.normals)))
    return eqx.tree_at(lambda g: g.covs, gaussians, jnp.asarray(covs))

"""Noise of points, estimated from the points: per level of the prior's confidence, and how many are independent."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.ops.constants import MAD_TO_STD
from emgs_jax.ops.ranks import kth_smallest
from emgs_jax.registration.rigid import MIN_PAIRS, median

NUM_LEVELS = 8  # of confidence
NUM_CELLS = 4  # along each side of the image, whose errors are compared; few, as errors may be similar over much of it


def level_edges(confidence: Float[Array, "p"], valid: Bool[Array, "p"]) -> Float[Array, "l"]:
    """Find the confidences that divide the valid points into eighths: the largest of each level but the last.

    Only the order counts, because networks use different scales. NaN without a valid point.
    """
    share = jnp.arange(1, NUM_LEVELS) * jnp.sum(valid)
    return kth_smallest(confidence, valid, -(-share // NUM_LEVELS) - 1)


def levels_of(confidence: Float[Array, "p"], edges: Float[Array, "l"]) -> Int[Array, "p"]:
    """Find the level of confidence of every point, 0 the lowest.

    Equal confidences have equal levels: if all are equal, all points have level 0.
    """
    return jnp.sum(confidence[:, None] > edges, axis=-1)


def robust_std(errors: Float[Array, "p"], valid: Bool[Array, "p"]) -> Float[Array, ""]:
    """Compute a robust standard deviation: `MAD_TO_STD` times the median absolute error; 0 without any."""
    return jnp.where(jnp.any(valid), MAD_TO_STD * median(jnp.abs(errors), valid), 0.0)


def noise_of_levels(
    errors: Float[Array, "p"], valid: Bool[Array, "p"], levels: Int[Array, "p"]
) -> tuple[Float[Array, ""], Float[Array, "l"]]:
    """Compute `robust_std` of all errors and of each level's; a level with too few takes that of all.

    This way the errors, not the confidence itself, decide how noisy a level is.
    """
    chosen = valid & jnp.append(levels == jnp.arange(NUM_LEVELS)[:, None], jnp.ones_like(valid)[None], axis=0)
    *of_levels, of_all = jax.vmap(robust_std, (None, 0))(errors, chosen)
    has_enough = jnp.sum(chosen[:-1], axis=1) >= MIN_PAIRS
    return of_all, jnp.where(has_enough, jnp.stack(of_levels), of_all)


def num_independent(
    errors: Float[Array, "p"], points: Float[Array, "p 3"], valid: Bool[Array, "p"]
) -> Float[Array, ""]:
    """Estimate how many independent measurements the points amount to, as errors of neighbouring points correlate.

    The image is cut into cells. If the points of a cell share an error, the variance of the cells' means equals that of
    all errors; if not, it falls with their number. The estimate is cells · var(errors) / var(means), between the number
    of cells and the number of points; without a valid point it is the number of cells.

    Args:
        errors: in standard deviations.
        points: camera frame.
    """
    plane = points[:, :2] / jnp.where(valid, points[:, 2], 1.0)[:, None]
    low = jnp.min(jnp.where(valid[:, None], plane, jnp.inf), axis=0)
    high = jnp.max(jnp.where(valid[:, None], plane, -jnp.inf), axis=0)
    places = jnp.clip((plane - low) / jnp.maximum(high - low, 1e-6) * NUM_CELLS, 0, NUM_CELLS - 1).astype(jnp.int32)
    cells = jnp.where(valid, places[:, 0] * NUM_CELLS + places[:, 1], NUM_CELLS**2)
    nothing = jnp.zeros(NUM_CELLS**2)
    count, total = (nothing.at[cells].add(values, mode="drop") for values in (jnp.ones_like(errors), errors))
    num_points, num_cells = jnp.sum(count), jnp.sum(count > 0)
    of_means = jnp.sum(total**2 / jnp.maximum(count, 1.0)) / jnp.maximum(num_points, 1.0)
    of_errors = jnp.sum(jnp.where(valid, errors, 0.0) ** 2) / jnp.maximum(num_points, 1.0)
    ratio = of_errors / jnp.where(of_means > 0, of_means, 1.0)
    found = jnp.clip(num_cells * ratio, num_cells, num_points)
    return jnp.where(num_points > 0, found, NUM_CELLS**2)

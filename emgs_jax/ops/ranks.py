"""Values by their rank, without a sort."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

DIGIT_BITS = 8  # found by one pass over the values


def kth_smallest(values: Float[Array, "p"], valid: Bool[Array, "p"], ranks: Int[Array, "r"]) -> Float[Array, "r"]:
    """Find the valid values with these ranks, 0 the smallest, exactly; NaN if there are fewer.

    Radix selection: floats sort like their bits, once those of negative ones are inverted. The digits of a result are
    found from the highest on, by a histogram of the values that start with the digits known so far.
    """
    bits = jax.lax.bitcast_convert_type(jax.lax.stop_gradient(values), jnp.int32)
    turned = bits ^ ((bits >> 31) & jnp.int32(0x7FFFFFFF))
    top = jnp.uint32(1 << 31)
    keys = jnp.where(valid, jax.lax.bitcast_convert_type(turned, jnp.uint32) ^ top, jnp.uint32(0xFFFFFFFF))
    known, left = jnp.zeros(ranks.shape, jnp.uint32), ranks  # remaining rank among the values with these first digits
    rows, num_digits = jnp.arange(ranks.shape[0])[:, None], 1 << DIGIT_BITS
    begins = jnp.ones((ranks.shape[0], keys.shape[0]), bool)
    for shift in range(32 - DIGIT_BITS, -1, -DIGIT_BITS):
        digits = ((keys >> shift) & (num_digits - 1)).astype(jnp.int32)
        counts = jnp.zeros((ranks.shape[0], num_digits), jnp.int32).at[rows, digits].add(begins.astype(jnp.int32))
        num_below = jnp.cumsum(counts, axis=-1)
        is_below = num_below <= left[:, None]
        left -= jnp.max(jnp.where(is_below, num_below, 0), axis=-1)
        known |= jnp.sum(is_below, axis=-1).astype(jnp.uint32) << shift
        begins = keys >> shift == (known >> shift)[:, None]
    # Look up the value itself by its bits, because it has a gradient.
    found = values[jnp.argmax(begins, axis=-1)]
    return jnp.where(ranks < jnp.sum(valid), found, jnp.nan)

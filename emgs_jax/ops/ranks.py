"""Values by their rank, without a sort."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

DIGIT_BITS = 8  # that one look at the values settles


def kth_smallest(values: Float[Array, "p"], valid: Bool[Array, "p"], ranks: Int[Array, "r"]) -> Float[Array, "r"]:
    """The valid values with these ranks, 0 the smallest, exactly; NaN where there are fewer.

    Radix selection: floats are ordered as their bits are, once those of negative ones are turned round. The digits of
    an answer are found from the highest on, by a histogram of the values that begin with what is known of it.
    """
    bits = jax.lax.bitcast_convert_type(jax.lax.stop_gradient(values), jnp.int32)
    turned = bits ^ ((bits >> 31) & jnp.int32(0x7FFFFFFF))
    top = jnp.uint32(1 << 31)
    keys = jnp.where(valid, jax.lax.bitcast_convert_type(turned, jnp.uint32) ^ top, jnp.uint32(0xFFFFFFFF))
    known, left = jnp.zeros(ranks.shape, jnp.uint32), ranks  # what is left of a rank among the values that begin so
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
    # The value itself, which has a gradient: where its bits are.
    found = values[jnp.argmax(begins, axis=-1)]
    return jnp.where(ranks < jnp.sum(valid), found, jnp.nan)

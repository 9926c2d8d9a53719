"""Values by their rank, without a sort."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def kth_smallest(values: Float[Array, "p"], valid: Bool[Array, "p"], ranks: Int[Array, "r"]) -> Float[Array, "r"]:
    """The valid values with these ranks, 0 the smallest, exactly; NaN where there are fewer.

    Floats are ordered as their bits are, once those of negative ones are turned round. The bits of an answer are found
    from the highest on, by how many values are smaller than each of the numbers that begin with what is known.
    """
    bits = jax.lax.bitcast_convert_type(jax.lax.stop_gradient(values), jnp.int32)
    turned = bits ^ ((bits >> 31) & jnp.int32(0x7FFFFFFF))
    top = jnp.uint32(1 << 31)
    keys = jnp.where(valid, jax.lax.bitcast_convert_type(turned, jnp.uint32) ^ top, jnp.uint32(0xFFFFFFFF))
    # Of one rank more bits at once, which is fewer looks; of several the looks would become wider than they save.
    digit_bits = 4 if ranks.shape[0] == 1 else 2
    digits = jnp.arange(1, 1 << digit_bits, dtype=jnp.uint32)
    known = jnp.zeros(ranks.shape, jnp.uint32)
    for shift in range(32 - digit_bits, -1, -digit_bits):
        begins = known[:, None] | (digits << shift)
        num_smaller = jnp.sum(keys < begins[..., None], axis=-1)
        known |= jnp.sum(num_smaller <= ranks[:, None], axis=-1).astype(jnp.uint32) << shift
    # The value itself, which has a gradient: where its bits are.
    is_it = keys == known[:, None]
    found = values[jnp.argmax(is_it, axis=-1)]
    return jnp.where(ranks < jnp.sum(valid), found, jnp.nan)

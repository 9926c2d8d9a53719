"""Semi-global aggregation against a path by path recursion in NumPy."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from stereo_scene import depth_config

from emgs_jax.prior.multiview.semi_global import aggregate

PREFIX = "prior.dense.depth.semi_global"
jitted_aggregate = eqx.filter_jit(aggregate)


def jitted(cost, gray, config):
    return np.asarray(jitted_aggregate(jnp.asarray(cost), jnp.asarray(gray), config))


def slow_aggregate(cost, gray, small, large, edge):
    """Eq. 13 of Hirschmüller 2008, from each pixel back to the border; beyond it the border's own column stands in."""
    height, width, count = cost.shape
    total = np.zeros(cost.shape)
    for dy, dx in ((1, 0), (1, 1), (1, -1), (-1, 0), (-1, 1), (-1, -1), (0, 1), (0, -1)):
        paths = np.zeros(cost.shape)
        rows = range(height) if dy >= 0 else range(height - 1, -1, -1)
        columns = range(width) if dx >= 0 else range(width - 1, -1, -1)
        for y in rows:
            for x in columns:
                py, px = y - dy, x - dx if dy == 0 else np.clip(x - dx, 0, width - 1)
                if not (0 <= py < height and 0 <= px < width):
                    paths[y, x] = cost[y, x]
                    continue
                before = paths[py, px]
                step = max(large / (1 + abs(gray[y, x] - gray[py, px]) / edge), small)
                for d in range(count):
                    near = [before[k] + small for k in (d - 1, d + 1) if 0 <= k < count]
                    paths[y, x, d] = cost[y, x, d] + min(before[d], *near, before.min() + step) - before.min()
        total += paths
    return total / 8


def test_aggregation_is_the_recursion_along_eight_directions():
    rng = np.random.default_rng(0)
    cost, gray = rng.uniform(size=(7, 9, 6)).astype(np.float32), rng.uniform(size=(7, 9)).astype(np.float32)
    config = depth_config(f"{PREFIX}.small_step=0.1", f"{PREFIX}.large_step=0.5", f"{PREFIX}.edge=0.2").semi_global
    actual = jitted(cost, gray, config)
    np.testing.assert_allclose(actual, slow_aggregate(cost, gray, 0.1, 0.5, 0.2), rtol=1e-5, atol=1e-6)

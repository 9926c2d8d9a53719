"""Move arrays between NumPy and the device, and convert poses."""

from collections.abc import Iterable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from scipy.spatial.transform import Rotation


def on_device(tree: Any) -> Any:
    """Convert NumPy leaves to JAX arrays; `jnp.asarray` would compile a program for each shape."""
    return jax.tree.map(jax.device_put, tree)


@eqx.filter_jit
def _poses(matrices: jax.Array, is_finite: jax.Array) -> jaxlie.SE3:
    return jaxlie.SE3(jnp.where(is_finite[..., None], jaxlie.SE3.from_matrix(matrices).wxyz_xyz, jnp.nan))


def fetched(trees: Iterable[Any]) -> Iterator[Any]:
    """Yield trees of arrays on the host; the next one is computed while the caller uses one."""
    pending = None
    for tree in trees:
        if pending is not None:
            yield jax.device_get(pending)
        pending = tree
    if pending is not None:
        yield jax.device_get(pending)


def to_se3(matrices: np.ndarray) -> jaxlie.SE3:
    """Convert (..., 4, 4) float64 to poses; a matrix that is not finite gives NaN, which a step marks as lost."""
    matrices = np.asarray(matrices, np.float64)
    is_finite = np.asarray(np.isfinite(matrices).all(axis=(-2, -1)))
    filled = np.where(is_finite[..., None, None], matrices, np.eye(4)).astype(np.float32)
    return _poses(*on_device((filled, is_finite)))


def to_matrix(wxyz_xyz: np.ndarray) -> np.ndarray:
    """Convert jaxlie's seven numbers of a pose to a (4, 4) float64 matrix."""
    pose, (w, x, y, z, *translation) = np.eye(4), np.asarray(wxyz_xyz, np.float64)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), translation
    return pose

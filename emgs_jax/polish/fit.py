"""Initial splats, and their fit to the frames: Adam, one frame a step, in an order that the seed says."""

import hashlib
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from emgs_jax.data.spool import Spool
from emgs_jax.io.files import atomic_write
from emgs_jax.io.npz import read_npz
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.ranges import number
from emgs_jax.polish.splats import Anchors, Appearance, LossConfig, initial, loss

SAME_SURFACE = 0.05  # of the depth; a splat so near the map's surface stands for it
STEEPEST = 0.3  # cosine; surfaces seen at a more grazing angle begin with splats that are no longer than at it


@dataclass(frozen=True)
class Rates:
    """Adam's learning rate of each part of `Appearance`."""

    colors: float = number(low=0, high=10)
    logit: float = number(low=0, high=10)
    log_std: float = number(low=0, high=10)
    turn: float = number(low=0, high=10)
    shift: float = number(low=0, high=10)


@dataclass(frozen=True)
class PolishConfig:
    """How splats are made and fitted.

    Args:
        pixels_per_splat: of the frame that makes it.
        held_out_every: every so many-th frame is never fitted, the first one included.
        steps: of Adam, one frame each.
        final_rate: of the learning rates, at the last step; exponentially from 1.
        opacity: of a splat when it begins.
        min_opacity: what has less at the end is left out.
        every: steps after which a stopped fit goes on from there.
        seed: of the order of the frames.
        rates: learning rates.
        loss: its weights.
    """

    rates: Rates
    loss: LossConfig
    pixels_per_splat: int = number(low=1, high=10_000)
    held_out_every: int = number(low=2, high=1_000_000)
    steps: int = number(low=0, high=10_000_000)
    final_rate: float = number(low=1e-6, high=1)
    opacity: float = number(low=0.01, high=0.99)
    min_opacity: float = number(low=0, high=1)
    every: int = number(low=1, high=10_000_000)
    seed: int = number(low=0, high=2**31 - 1)


def is_held_out(row: int, config: PolishConfig) -> bool:
    """Test whether the frame of this row is kept from the fit, for the comparison."""
    return row % config.held_out_every == 0


class Seeds:
    """Splats on the surface that frames see, one for `pixels_per_splat` of the frame that has the most pixels of it."""

    def __init__(self, camera: Camera, config: PolishConfig) -> None:
        self._camera, self._spacing = camera, float(np.sqrt(config.pixels_per_splat))
        self._rows: list[tuple[np.ndarray, ...]] = []  # means, colours, axes, std of every frame that adds some

    def add(self, view, image: np.ndarray, pose: np.ndarray) -> None:
        """Fill the cells of a frame in which no splat is yet.

        Args:
            view: `DenseView` of the map at the frame.
            image: RGB in [0, 1], (h, w, 3).
            pose: T_world_camera.
        """
        height, width = image.shape[:2]
        counts = [int(np.ceil(side / self._spacing)) for side in (height, width)]
        y, x = (
            np.minimum(((np.arange(n) + 0.5) * self._spacing).astype(int), side - 1)
            for n, side in zip(counts, (height, width), strict=True)
        )
        is_free = view.valid[np.ix_(y, x)] & ~self._held(view, pose, counts)
        y, x = y[np.nonzero(is_free)[0]], x[np.nonzero(is_free)[1]]
        points, normals = (np.asarray(values[y, x], np.float64) for values in (view.points, view.normals))
        rays = points - pose[:3, 3]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        cosine = -np.einsum("ni,ni->n", rays, normals)
        along = rays + cosine[:, None] * normals + 1e-6 * pose[:3, 0]  # in which direction the surface is foreshortened
        along -= np.einsum("ni,ni->n", along, normals)[:, None] * normals
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        axes = np.stack([along, np.cross(normals, along), normals], axis=2)
        std = 0.5 * self._spacing * view.depth[y, x] / float(np.mean(np.asarray(self._camera.focal)))
        std = np.stack([std / np.clip(cosine, STEEPEST, 1.0), std], axis=1)
        self._rows.append((points, image[y, x], axes, std))

    def _held(self, view, pose: np.ndarray, counts: Sequence[int]) -> np.ndarray:
        """Mark the cells of the frame that hold a splat on the surface that the map shows there."""
        held, (height, width) = np.zeros(counts, bool), view.depth.shape
        for means, *_ in self._rows:
            local = (means - pose[:3, 3]) @ pose[:3, :3]
            z = np.where(local[:, 2] > 0, local[:, 2], 1.0)
            u, v = (local[:, :2] / z[:, None] * np.asarray(self._camera.focal) + np.asarray(self._camera.center)).T
            inside = (local[:, 2] > 0) & (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5)
            u, v, z = u[inside], v[inside], z[inside]
            near = np.abs(view.depth[np.rint(v).astype(int), np.rint(u).astype(int)] - z) < SAME_SURFACE * z
            cells = (np.clip(values[near] + 0.5, 0, None) / self._spacing for values in (v, u))
            held[tuple(np.minimum(cell.astype(int), n - 1) for cell, n in zip(cells, counts, strict=True))] = True
        return held

    def anchors(self, noise: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> tuple[Anchors, np.ndarray]:
        """All of them, and their colours; `noise(means, normals)` is the map's, m."""
        means, colors, axes, std = (np.concatenate(column) for column in zip(*self._rows, strict=True))
        values = means, axes, std, noise(means, axes[..., 2])
        return Anchors(*(jnp.asarray(value, jnp.float32) for value in values)), colors


def fit(
    anchors: Anchors,
    colors: np.ndarray,
    frames: tuple[Spool, np.ndarray],
    camera: Camera,
    config: PolishConfig,
    path: Path,
    on_step: Callable[[int, float], None] = lambda step, psnr: None,
) -> Appearance:
    """Fit the splats' appearance to frames; the same call goes on where one that was stopped had written `path`.

    Args:
        anchors: where the splats begin.
        colors: (n, 3), likewise.
        frames: `loss`'s target of each frame (h, w, 4), and T_world_camera of each, (m, 4, 4).
        camera: of the frames.
        config: how.
        path: of what a stopped fit goes on from; gone at the end.
        on_step: told the number of each step, and the PSNR (dB) of its frame before it.
    """
    import optax  # an extra

    targets, poses = frames
    adam = optax.scale_by_adam(eps=1e-15)  # as 3DGS
    fitted = initial(jnp.asarray(colors, jnp.float32), jnp.float32(config.opacity))
    moments = adam.init(fitted)

    @jax.jit
    def step(fitted: Appearance, moments, anchors: Anchors, target: Float[Array, "h w 4"], T: jaxlie.SE3, decay: Array):
        (_, error), slope = jax.value_and_grad(loss, has_aux=True)(fitted, anchors, target, T, camera, config.loss)
        change, moments = adam.update(slope, moments)
        parts = {
            name: getattr(fitted, name) - decay * rate * getattr(change, name)
            for name, rate in vars(config.rates).items()
        }
        return Appearance(**parts), moments, error

    signature = _signature(anchors, colors, config)
    first, (fitted, moments) = _read(path, (fitted, moments), signature)
    for number_ in range(first, config.steps):
        epoch, place = divmod(number_, len(poses))
        row = np.random.default_rng((config.seed, epoch)).permutation(len(poses))[place]
        target = jnp.asarray(targets[row], jnp.float32)
        pose = jaxlie.SE3.from_matrix(jnp.asarray(poses[row], jnp.float32))
        decay = jnp.float32(config.final_rate ** (number_ / max(config.steps - 1, 1)))
        fitted, moments, error = step(fitted, moments, anchors, target, pose, decay)
        on_step(number_, -10.0 * float(np.log10(max(float(error), 1e-12))))
        if (number_ + 1) % config.every == 0:
            _write(path, number_ + 1, (fitted, moments), signature)
    path.unlink(missing_ok=True)
    return fitted


def _signature(anchors: Anchors, colors: np.ndarray, config: PolishConfig) -> str:
    """Return a digest of where the splats begin and of all settings."""
    settings = replace(config, loss=jax.tree.map(float, config.loss))  # whose arrays would be shown by their shapes
    digest = hashlib.sha256(repr(settings).encode())
    for values in (*jax.tree.leaves(anchors), colors):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _write(path: Path, step: int, state, signature: str) -> None:
    buffer = io.BytesIO()
    leaves = {f"leaf{number}": np.asarray(leaf) for number, leaf in enumerate(jax.tree.leaves(state))}
    np.savez(buffer, step=step, signature=signature, **leaves)
    with atomic_write(path) as handle:
        handle.write(buffer.getvalue())


def _read(path: Path, state, signature: str):
    """Return the step to go on from and the state there; the beginning where there is none, or one of another fit."""
    if not path.is_file():
        return 0, state
    leaves, tree = jax.tree.flatten(state)
    found = read_npz(path.read_bytes())
    if str(found.get("signature")) != signature:
        return 0, state
    leaves = [jnp.asarray(found[f"leaf{number}"], leaf.dtype) for number, leaf in enumerate(leaves)]
    return int(found["step"]), jax.tree.unflatten(tree, leaves)


def without_transparent(anchors: Anchors, fitted: Appearance, min_opacity: float) -> tuple[Anchors, Appearance]:
    """The splats whose opacity is at least `min_opacity`."""
    keep = np.asarray(jax.nn.sigmoid(fitted.logit)) >= min_opacity
    return jax.tree.map(lambda leaf: leaf[keep], (anchors, fitted))

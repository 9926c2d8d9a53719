"""Polish a finished run: from its frames and map to splats.ply, polish.json and pictures of held-out frames."""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from tqdm import tqdm

from emgs_jax.data.readable import ReadableFrames
from emgs_jax.data.spool import Spool
from emgs_jax.device.arrays import on_device, to_se3
from emgs_jax.drawing.colors import save_png, to_bytes
from emgs_jax.drawing.splats import owners
from emgs_jax.evaluation.rendering import rendering_metrics, score_view
from emgs_jax.evaluation.trajectory import align_poses, ate
from emgs_jax.gaussian_map import confirmed
from emgs_jax.gaussians import Gaussians
from emgs_jax.io.files import write_json
from emgs_jax.io.packages import extra
from emgs_jax.io.ply import save_gaussians_ply
from emgs_jax.io.trajectory import save_trajectory_tum
from emgs_jax.ops.camera import Camera
from emgs_jax.polish.fit import PolishConfig, Views, fit, is_held_out, place_on_splats, with_room, without_transparent
from emgs_jax.polish.seeds import Seeds
from emgs_jax.polish.splats import Anchors, Appearance, LossConfig, draw, gaussians_of, relative_gain, ssim
from emgs_jax.render.composite import Rendering
from emgs_jax.render.densify import DenseView, DensifyConfig, densify
from emgs_jax.runs.finished_run import POLISH, POLISHED_PATH_FILE, SPLATS_FILE, FinishedRun
from emgs_jax.runs.moving import moving_mask
from emgs_jax.semantics import classify

_, METRICS_FILE, PICTURE_FILE, CHECKPOINT_FILE, _ = POLISH
OPTAX = "optax", "splats are fitted by optax (polish=none fits none)", "polish"  # as `extra` takes it
MAX_PICTURES = 4
Seen: TypeAlias = tuple[np.ndarray, DenseView]  # image (h, w, 3) in [0, 1] of a frame, and the map from its pose
Nearest: TypeAlias = Callable[[np.ndarray], np.ndarray]
_densify, _classify = eqx.filter_jit(densify), eqx.filter_jit(classify)
_ssim, _gain = jax.jit(ssim), jax.jit(relative_gain)


def polish(
    run: FinishedRun, dataset: ReadableFrames, config: PolishConfig, densify_config: DensifyConfig
) -> dict[str, Any]:
    """Fit splats to all placed frames but the held-out ones; write them, and pictures of the held-out ones.

    Returns the contents of polish.json. Raises ValueError if the map is empty, if there is no frame to fit or to
    compare with, or if optax is not installed.

    Args:
        run: finished run; the files go into its folder.
        densify_config: the run's settings of densification.
    """
    extra(*OPTAX)
    gaussians = confirmed(run.map)
    if not np.asarray(gaussians.valid).any():
        raise ValueError(f"{run.folder}: the map has no Gaussian to begin with: run again")
    rows = [int(row) for row in np.flatnonzero(run.is_placed)]
    held, fitted_rows = ([row for row in rows if is_held_out(row, config) == kind] for kind in (True, False))
    if not held or not fitted_rows:
        raise ValueError(
            f"{run.folder} has {len(rows)} placed frames, of which polishing fits some and compares the others "
            f"(polish.held_out_every={config.held_out_every}): map more frames (dataset.stop, dataset.stride)"
        )

    def seen(row: int) -> Seen:
        view = jax.device_get(_densify(gaussians, to_se3(run.poses[row]), run.camera, densify_config))
        view, frame = eqx.tree_at(lambda v: v.rendering, view, None), dataset[row]
        image = frame.image / np.float32(255)
        is_out = moving_mask(run.frames[row], image.shape[1::-1])
        is_out = is_out if frame.mask is None else is_out | frame.mask
        if is_out.any():  # masked pixels keep the map's colours and get no splat
            image = np.where(is_out[..., None], view.colors, image)
            view = eqx.tree_at(lambda v: v.valid, view, view.valid & ~is_out)
        return image, view

    nearest = _nearest(gaussians)
    seeds, targets, gains = Seeds(run.camera, config.pixels_per_splat), Spool(), []
    for row in tqdm(fitted_rows, desc="splats", unit="frame"):
        image, view = seen(row)
        seeds.add(view, image, run.poses[row])
        targets.append(target_of(image, view))
        gains.append(np.asarray(_gain(view.colors, image, view.valid)) ** config.exposures)
    for row in held:  # surface that only these see keeps the map's colours: their images stay out
        view = seen(row)[1]
        seeds.add(view, view.colors, run.poses[row])
    anchors, colors = seeds.anchors(_map_noise(gaussians, nearest))
    views = Views(targets, run.poses[fitted_rows], _spreads(run, fitted_rows, config), np.stack(gains))
    fitted, views = _fitted(anchors, colors, views, run, config)
    anchors, fitted = without_transparent(anchors, fitted, config.min_opacity)
    poses, all_gains = run.poses.copy(), _between(views.gains, fitted_rows, len(run.poses))
    poses[fitted_rows] = views.poses
    (run.folder / POLISHED_PATH_FILE).unlink(missing_ok=True)  # of an earlier fit
    if config.poses:
        targets = Spool()
        for row in held:
            targets.append(target_of(*seen(row)))
        views = Views(targets, run.poses[held], _spreads(run, held, config), all_gains[held])
        poses[held] = place_on_splats(anchors, fitted, views, run.camera, config)
        times = [run.frames[row]["timestamp"] for row in rows]
        save_trajectory_tum(run.folder / POLISHED_PATH_FILE, times, poses[rows])
    splats, opacity = gaussians_of(anchors, fitted)
    count = _save_splats(run, splats, opacity, nearest)
    metrics = {"polish/num_splats": count, "polish/num_fitted": len(fitted_rows), "polish/num_held_out": len(held)}
    metrics |= _compare(run, dataset, held, seen, (splats, opacity, poses, all_gains, config.loss))
    write_json(run.folder / METRICS_FILE, metrics)
    return metrics


def _fitted(
    anchors: Anchors, colors: np.ndarray, views: Views, run: FinishedRun, config: PolishConfig
) -> tuple[Appearance, Views]:
    """Run `fit` with a progress bar."""
    with tqdm(total=config.steps, desc="polishing", unit="step") as bar:
        recent: list[float] = []

        def on_step(step: int, psnr: float) -> None:
            recent.append(psnr)
            bar.set_postfix_str(f"{np.mean(recent[-len(views.poses) :]):.1f} dB", refresh=False)
            bar.update(step + 1 - bar.n)

        return fit(anchors, colors, views, run.camera, config, run.folder / CHECKPOINT_FILE, on_step)


def _between(gains: np.ndarray, rows: list[int], count: int) -> np.ndarray:
    """Interpolate the gains of all frames (count, 3) from those of `rows`."""
    return np.stack([np.interp(np.arange(count), rows, channel) for channel in gains.T], axis=1)


def _save_splats(run: FinishedRun, splats: Gaussians, opacity: jax.Array, nearest: Nearest) -> int:
    """Write splats.ply, with the class of the nearest Gaussian if the map has classes; return the number of splats."""
    gaussians, labels, classes = confirmed(run.map), None, ()
    if run.text is not None and gaussians.features.shape[-1]:
        text, classes = on_device(np.asarray(run.text.vectors, np.float32)), run.text.names
        labels = np.asarray(_classify(gaussians, text))[nearest(np.asarray(splats.means))]
    shown = jnp.clip(splats.colors, 0, 1), opacity, splats.normals, labels, classes
    return save_gaussians_ply(run.folder / SPLATS_FILE, splats.means, splats.covs, *shown)


def target_of(image: np.ndarray, view: DenseView) -> np.ndarray:
    """Make the target of `loss`, (h, w, 4), in half floats; a depth beyond their range counts as none."""
    has_depth = view.valid & (view.depth < np.finfo(np.float16).max)
    return np.concatenate([image, np.where(has_depth, view.depth, 0.0)[..., None]], axis=-1).astype(np.float16)


def _spreads(run: FinishedRun, rows: list[int], config: PolishConfig) -> np.ndarray:
    """Compute square roots of the frames' covariances (m, 6, 6); 0 if poses are fixed.

    A frame without a covariance, such as the first, to which the others are relative, takes that of the nearest frame
    with one.
    """
    spreads = np.zeros((len(rows), 6, 6))
    known = np.array([row for row, line in enumerate(run.frames) if line.get("covariance") is not None])
    for number, row in enumerate(rows) if config.poses and len(known) else ():
        covariance = run.frames[known[np.abs(known - row).argmin()]]["covariance"]
        values, axes = np.linalg.eigh(np.asarray(covariance, np.float64).reshape(6, 6))
        spreads[number] = axes * np.sqrt(np.maximum(values, 0.0))
    return spreads


def _nearest(gaussians: Gaussians) -> Nearest:
    """Make a function from points (n, 3) to rows of the Gaussians with the nearest means."""
    rows = np.flatnonzero(np.asarray(gaussians.valid))
    means = np.asarray(gaussians.means)[rows]
    return lambda points: rows[owners(points, means)]


def _map_noise(gaussians: Gaussians, nearest: Nearest) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Look up the standard deviation along the normal (m) of each point's nearest Gaussian."""
    covs = np.asarray(gaussians.covs)

    def noise(means: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return np.sqrt(np.einsum("ni,nij,nj->n", normals, covs[nearest(means)], normals))

    return noise


@eqx.filter_jit
def _drawn(splats: Gaussians, opacity: jax.Array, T: jaxlie.SE3, camera: Camera, terms: LossConfig) -> Rendering:
    return draw(splats, opacity, T, camera, terms.render)


def _picture(*arguments: Any) -> tuple[Rendering, int]:
    """Render the splats to the host, and count those that did not fit."""
    drawn = jax.device_get(_drawn(*arguments))
    return drawn, int(drawn.overflow)


def _compare(
    run: FinishedRun, dataset: ReadableFrames, held: list[int], seen: Callable[[int], Seen], drawn: tuple
) -> dict[str, Any]:
    """Compute PSNR and SSIM over pixels that the map covers, and depth errors and ATE where the truth is known.

    *Before* is the map at the run's poses, *after* the splats at theirs. Where the map covers nothing, both pictures
    equal the image in SSIM and do not count in PSNR; a frame of which the map covers nothing does not count at all. No
    pixel of a held-out frame is used to estimate its brightness.
    """
    splats, opacity, poses, gains, terms = drawn
    known = run.has_truth & run.is_placed
    metrics: dict[str, Any] = {}
    scale = None
    if known.any():
        with_scale = run.provenance["config"].get("evaluation", {}).get("alignment") == "sim3"
        for name, path in (("before", run.poses[known]), ("after", poses[known])):
            alignment, _ = align_poses(path, run.truth[known], with_scale)
            metrics[f"polish/{name}_ate_m"] = ate(path[:, :3, 3], run.truth[known][:, :3, 3], alignment)
            scale = alignment.scale if scale is None else scale
    scores: dict[str, list] = {"before": [], "after": []}
    psnr, similarity = {name: [] for name in scores}, {name: [] for name in scores}
    strips = []
    for row in tqdm(held, desc="held-out frames", unit="frame"):
        image, view = seen(row)
        after, terms = with_room(partial(_picture, splats, opacity, to_se3(poses[row]), run.camera), terms)
        pictures = {
            "before": (view.colors, np.where(view.valid, view.depth, 0.0)),
            "after": (np.float32(gains[row]) * after.values, after.depth),
        }
        for name, (colors, depth) in pictures.items() if view.valid.any() else ():
            shown = np.where(view.valid[..., None], np.clip(colors, 0, 1), image).astype(np.float32)
            psnr[name].append(np.mean((shown - image)[view.valid] ** 2))
            similarity[name].append(float(_ssim(shown, image)))
            if scale is not None:
                scores[name].append(score_view(dataset[row], depth, colors, scale, np.inf))
        strips.append(np.concatenate([image, np.clip(view.colors, 0, 1), np.clip(pictures["after"][0], 0, 1)], axis=1))
    metrics["polish/num_covered"] = len(psnr["before"])
    for name in scores if psnr["before"] else ():
        metrics[f"polish/{name}_psnr_db"] = float(-10 * np.log10(max(np.mean(psnr[name]), 1e-12)))
        metrics[f"polish/{name}_ssim"] = float(np.mean(similarity[name]))
        for key, value in rendering_metrics(scores[name]).items() if scale is not None else ():
            if key.startswith("rendering/depth"):
                metrics[f"polish/{name}_{key.removeprefix('rendering/')}"] = value
    shown = [strips[int(row)] for row in np.unique(np.linspace(0, len(strips) - 1, MAX_PICTURES).astype(int))]
    save_png(run.folder / PICTURE_FILE, to_bytes(np.concatenate(shown)))
    return metrics

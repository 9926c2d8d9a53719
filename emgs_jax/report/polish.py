"""A finished run polished: its frames and map in, splats.ply, polish.json and pictures of held-out frames out."""

import importlib.util
from collections.abc import Callable
from typing import Any

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree
from tqdm import tqdm

from emgs_jax.data.readable import ReadableFrames
from emgs_jax.data.spool import Spool
from emgs_jax.evaluation.rendering import rendering_metrics, score_view
from emgs_jax.evaluation.trajectory import align_poses
from emgs_jax.gaussian_map import confirmed
from emgs_jax.io.files import write_json
from emgs_jax.io.ply import save_gaussians_ply
from emgs_jax.polish.fit import PolishConfig, Seeds, fit, is_held_out, without_transparent
from emgs_jax.polish.splats import draw, gaussians_of, ssim
from emgs_jax.render.densify import DensifyConfig, densify
from emgs_jax.report.recorded_run import POLISH, RecordedRun
from emgs_jax.running.convert import to_se3
from emgs_jax.running.executables import stored

SPLATS_FILE, METRICS_FILE, PICTURE_FILE, CHECKPOINT_FILE = POLISH
MAX_PICTURES = 4
_densify, _ssim = stored(densify), jax.jit(ssim)


def polish(
    run: RecordedRun, dataset: ReadableFrames, config: PolishConfig, densify_config: DensifyConfig
) -> dict[str, Any]:
    """Fit splats to all placed frames but the held-out ones; write them, and how the held-out ones look before, after.

    Args:
        run: whose folder is written into.
        dataset: its images.
        config: how.
        densify_config: how the run drew its map.

    Returns:
        What polish.json says.

    Raises:
        ValueError: the map is empty, there is no frame to fit or to compare with, or optax is not installed.
    """
    if importlib.util.find_spec("optax") is None:
        raise ValueError('emgs polish needs optax: pip install "emgs_jax[polish]"')
    gaussians = confirmed(run.map)
    if not np.asarray(gaussians.valid).any():
        raise ValueError(f"{run.folder}: the map has no Gaussian to begin with: run again")
    rows = [int(row) for row in np.flatnonzero(run.is_placed)]
    held, fitted_rows = ([row for row in rows if is_held_out(row, config) == kind] for kind in (True, False))
    if not held or not fitted_rows:
        raise ValueError(f"{run.folder} has {len(rows)} placed frames: too few to fit some and compare others")

    def seen(row: int):
        view = jax.device_get(_densify(gaussians, to_se3(run.poses[row]), run.camera, densify_config))
        return dataset[row].image / np.float32(255), eqx.tree_at(lambda v: v.rendering, view, None)

    seeds, targets = Seeds(run.camera, config), Spool()
    for row in tqdm(fitted_rows, desc="splats", unit="frame"):
        image, view = seen(row)
        seeds.add(view, image, run.poses[row])
        depth = np.where(view.valid, view.depth, 0.0)
        targets.append(np.concatenate([image, depth[..., None]], axis=-1).astype(np.float16))
    for row in held:  # what only these see is as the map has it: their images stay out
        _, view = seen(row)
        seeds.add(view, view.colors, run.poses[row])
    anchors, colors = seeds.anchors(_map_noise(gaussians))
    with tqdm(total=config.steps, desc="polishing", unit="step") as bar:
        recent: list[float] = []

        def on_step(step: int, psnr: float) -> None:
            recent.append(psnr)
            bar.set_postfix_str(f"{np.mean(recent[-len(fitted_rows) :]):.1f} dB", refresh=False)
            bar.update(step + 1 - bar.n)

        frames = targets, run.poses[fitted_rows]
        fitted = fit(anchors, colors, frames, run.camera, config, run.folder / CHECKPOINT_FILE, on_step)
    splats, opacity = gaussians_of(*without_transparent(anchors, fitted, config.min_opacity))
    count = save_gaussians_ply(
        run.folder / SPLATS_FILE, splats.means, splats.covs, jnp.clip(splats.colors, 0, 1), opacity, splats.normals
    )
    metrics = {"polish/num_splats": count, "polish/num_fitted": len(fitted_rows), "polish/num_held_out": len(held)}
    metrics |= _compare(run, dataset, held, seen, (splats, opacity, config))
    write_json(run.folder / METRICS_FILE, metrics)
    return metrics


def _map_noise(gaussians):
    """The standard deviation along the normal (m) of the Gaussian that is nearest to each point."""
    valid = np.asarray(gaussians.valid)
    tree, covs = cKDTree(np.asarray(gaussians.means)[valid]), np.asarray(gaussians.covs)[valid]

    def noise(means: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return np.sqrt(np.einsum("ni,nij,nj->n", normals, covs[tree.query(means)[1]], normals))

    return noise


def _compare(
    run: RecordedRun, dataset: ReadableFrames, held: list[int], seen: Callable, drawn: tuple
) -> dict[str, Any]:
    """PSNR and SSIM over the pixels that the map covers, and depth errors where the truth is known, before and after.

    Where the map covers nothing both pictures are the image itself in SSIM, and do not count in PSNR.
    """
    splats, opacity, config = drawn
    known = run.has_truth & run.is_placed
    poses = (run.poses[known], run.truth[known]) if known.any() else None
    is_metric = run.provenance["config"].get("evaluation", {}).get("alignment") != "sim3"
    scale = None if poses is None else align_poses(*poses, with_scale=not is_metric)[0].scale
    picture = eqx.filter_jit(draw)
    scores: dict[str, list] = {"before": [], "after": []}
    psnr, similarity = {name: [] for name in scores}, {name: [] for name in scores}
    strips = []
    for row in tqdm(held, desc="held-out frames", unit="frame"):
        image, view = seen(row)
        after = jax.device_get(picture(splats, opacity, to_se3(run.poses[row]), run.camera, config.loss.render))
        pictures = {
            "before": (view.colors, np.where(view.valid, view.depth, 0.0)),
            "after": (after.values, after.depth),
        }
        for name, (colors, depth) in pictures.items():
            shown = np.where(view.valid[..., None], np.clip(colors, 0, 1), image).astype(np.float32)
            psnr[name].append(np.mean((shown - image)[view.valid] ** 2))
            similarity[name].append(float(_ssim(shown, image)))
            if scale is not None:
                scores[name].append(score_view(dataset[row], depth, colors, scale, np.inf))
        strips.append(np.concatenate([image, np.clip(view.colors, 0, 1), np.clip(after.values, 0, 1)], axis=1))
    metrics: dict[str, Any] = {}
    for name in scores:
        metrics[f"polish/{name}_psnr_db"] = float(-10 * np.log10(max(np.mean(psnr[name]), 1e-12)))
        metrics[f"polish/{name}_ssim"] = float(np.mean(similarity[name]))
        for key, value in rendering_metrics(scores[name]).items() if scale is not None else ():
            if key.startswith("rendering/depth"):
                metrics[f"polish/{name}_{key.removeprefix('rendering/')}"] = value
    shown = [strips[int(row)] for row in np.unique(np.linspace(0, len(strips) - 1, MAX_PICTURES).astype(int))]
    pixels = np.rint(255 * np.concatenate(shown)).astype(np.uint8)
    if not cv2.imwrite(str(run.folder / PICTURE_FILE), cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)):
        raise OSError(f"{run.folder / PICTURE_FILE} cannot be written: is the disk full?")
    return metrics

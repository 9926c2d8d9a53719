"""Pictures of an answer: relevance of the map for a word from any pose, and the map's features as colours."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from emgs_jax.device.arrays import to_se3
from emgs_jax.drawing.colors import class_colors, save_figure, save_png
from emgs_jax.gaussian_map import confirmed
from emgs_jax.gaussians import Gaussians
from emgs_jax.io.files import write_file
from emgs_jax.ops.camera import Camera, downscale
from emgs_jax.render.composite import RenderConfig, render
from emgs_jax.runs.finished_run import FinishedRun, render_config
from emgs_jax.runs.query import GREY, Answer, heat, hot, painted
from emgs_jax.semantics import principal_colors

QUERY_PICTURE, FEATURES_PICTURE = "query.png", "features.png"
LABELS_FOLDER, CLASSES_FILE = "labels", "classes.txt"
WORDS_AT_ONCE = 16  # drawn together
MAX_POSES, SMALL_WIDTH = 60, 64  # number of poses tried, evenly spread, and width of their images
MAX_LEGEND, KEYS_PER_LINE = 24, 6  # words of a legend
_colors = eqx.filter_jit(principal_colors)


class View(NamedTuple):
    """A pose (4, 4), camera -> map, and what to call it."""

    title: str
    pose: np.ndarray


@eqx.filter_jit
def _drawn(
    gaussians: Gaussians, values: jax.Array, pose: jaxlie.SE3, camera: Camera, config: RenderConfig
) -> tuple[jax.Array, jax.Array]:
    drawing = render(gaussians, values, pose, camera, config)
    return drawing.values, drawing.alpha


def drawn(run: FinishedRun, gaussians: Gaussians, values: np.ndarray, view: View, camera: Camera) -> np.ndarray:
    """Render values (n, v) of the Gaussians as an image (h, w, v); nan where the map shows nothing."""
    config, pose = render_config(run), to_se3(view.pose)
    values, alpha = jax.device_get(_drawn(gaussians, jnp.asarray(values, jnp.float32), pose, camera, config))
    is_seen = alpha >= max(float(config.min_alpha), 1e-6)
    return np.where(is_seen[..., None], values / np.where(is_seen, alpha, 1.0)[..., None], np.nan)


def views_of(run: FinishedRun) -> list[View]:
    """Choose poses of frames that are not lost, at most `MAX_POSES`, evenly spread."""
    rows = np.flatnonzero(run.is_placed)
    chosen = np.unique(np.linspace(0, len(rows) - 1, min(MAX_POSES, len(rows))).astype(int))
    return [View(f"frame {run.frames[row]['index']}", run.poses[row]) for row in rows[chosen]]


def frame_view(run: FinishedRun, frame: int) -> View:
    """Return the pose of one frame; raise ValueError if the run has none."""
    known = [line["index"] for line in run.frames]
    if frame not in known:
        raise ValueError(f"{run.folder} has no pose of frame={frame}: choose one from {min(known)} to {max(known)}")
    return View(f"frame {frame}", run.poses[known.index(frame)])


def best_views(run: FinishedRun, answer: Answer, count: int) -> list[list[View]]:
    """Find for each word the poses from which most pixels answer, best first; none without an answer."""
    camera = downscale(run.camera, -(-run.camera.width // SMALL_WIDTH))
    words = len(answer.question.words.names)
    answers = answer.relevance.labels[:, None] == np.arange(words)
    views, scores = views_of(run), np.zeros((MAX_POSES, words))
    for row, view in enumerate(views):
        scores[row] = np.nansum(drawn(run, answer.gaussians, answers.astype(np.float32), view, camera), axis=(0, 1))
    order = np.argsort(-scores, axis=0, kind="stable")
    return [[views[row] for row in order[:count, word] if scores[row, word] > 0] for word in range(words)]


def draw_answer(path: Path, run: FinishedRun, answer: Answer, views: Sequence[Sequence[View]], max_words: int) -> int:
    """Draw a line for each word and view: map, relevance of the word, classes; return the number of words."""
    names, has_classes = answer.question.words.names, len(views) > 1
    counts = [(answer.relevance.labels == word).sum() for word in range(len(views))]
    words = sorted(map(int, np.argsort(-np.array(counts), kind="stable")[:max_words]))
    colors, pictures = np.asarray(answer.gaussians.colors), []
    for word in words:
        layers = np.concatenate([colors, hot(heat(answer, word)), painted(answer)], axis=1)
        for view in views[word]:
            image = drawn(run, answer.gaussians, layers, view, run.camera)
            line = [(view.title, image[..., :3]), (f"relevance: {names[word]}", image[..., 3:6])]
            pictures.append(line + [("classes", image[..., 6:])] * has_classes)
    _save(path, pictures, legend(names, counts) if has_classes else {})
    return sum(bool(views[word]) for word in words)


def save_labels(folder: Path, run: FinishedRun, answer: Answer, views: Mapping[str, View]) -> None:
    """Write the map's word at each pixel as class images, which `features.folder` and others read.

    NAME.png holds 16-bit ids, 1 for the first word and so on, 0 for none of them or where the map shows nothing;
    classes.txt has a line `id word` for each.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = answer.question.words.names
    for name, view in views.items():
        save_png(folder / f"{name}.png", label_image(run, answer, view).astype(np.uint16))
    write_file(folder / CLASSES_FILE, "".join(f"{number} {name}\n" for number, name in enumerate(names, start=1)))


def label_image(run: FinishedRun, answer: Answer, view: View) -> np.ndarray:
    """Draw the number of the word with the largest share of each pixel (h, w), from 1; 0 for none of them."""
    labels, count = answer.relevance.labels + 1, len(answer.question.words.names) + 1
    best, found = np.zeros((run.camera.height, run.camera.width)), np.zeros((run.camera.height, run.camera.width), int)
    for first in range(0, count, WORDS_AT_ONCE):
        words = np.arange(first, first + WORDS_AT_ONCE)  # the same number each time, for one compilation
        share = np.nan_to_num(drawn(run, answer.gaussians, labels[:, None] == words, view, run.camera))
        found = np.where(share.max(-1) > best, words[share.argmax(-1)], found)
        best = np.maximum(best, share.max(-1))
    return found


def draw_features(path: Path, run: FinishedRun, views: Sequence[View]) -> None:
    """Draw the map's features as colours, see `principal_colors`, beside its own colours."""
    gaussians = confirmed(run.map)
    layers = np.concatenate([np.asarray(gaussians.colors), np.asarray(_colors(gaussians))], axis=1)
    images = [(view, drawn(run, gaussians, layers, view, run.camera)) for view in views]
    _save(path, [[(view.title, image[..., :3]), ("features", image[..., 3:])] for view, image in images])


def legend(names: Sequence[str], counts: Sequence[int]) -> dict[str, np.ndarray]:
    """Return the colours of `painted` for the words with most answers, in the order of the words."""
    most = sorted(np.argsort(-np.array(counts), kind="stable")[:MAX_LEGEND])
    return {names[word]: class_colors(len(names))[word] for word in most if counts[word]}


def _save(
    path: Path, lines: Sequence[Sequence[tuple[str, np.ndarray]]], legend: Mapping[str, np.ndarray] | None = None
) -> None:
    """Write titled images in lines of equal length above a legend, as PNG; without images, a line of text."""
    columns = max((len(line) for line in lines), default=1)
    height, width = lines[0][0][1].shape[:2] if lines else (1, 4)
    handles = [Patch(color=color, label=name) for name, color in (legend or {}).items()] if lines else []
    keys = -(-len(handles) // KEYS_PER_LINE)  # lines of the legend
    size = 3.6 * columns, max(1.0, len(lines) * (3.6 * height / width + 0.35) + 0.25 * keys)
    figure = Figure(figsize=size, facecolor="white", layout="constrained")
    if not lines:
        figure.suptitle("no answer is seen from these poses")
    panels = figure.subplots(len(lines), columns, squeeze=False).ravel() if lines else ()
    for axes, (title, image) in zip(panels, itertools.chain(*lines), strict=True):
        axes.imshow(np.where(np.isfinite(image), image, GREY).clip(0.0, 1.0))
        axes.set_title(title, fontsize=9)
        axes.set_axis_off()
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=KEYS_PER_LINE, fontsize=9, frameon=False)
    save_figure(path, figure)

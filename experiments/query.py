"""Ask a finished map: `python -m experiments.query map=FOLDER text=chair`.

Writes query.json (objects with centre, box and score), semantic.npz (relevance of each Gaussian), semantic.ply,
query.png (relevance seen from poses), features.png and, with label_images=true, class images.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

from emgs_jax.config.configure import build
from emgs_jax.data.class_file import read_classes
from emgs_jax.features.text import TextEmbeddings
from emgs_jax.io.files import check_writable
from emgs_jax.io.trajectory import load_trajectory_tum
from emgs_jax.report.query_pictures import (
    FEATURES_PICTURE,
    LABELS_FOLDER,
    QUERY_PICTURE,
    View,
    best_views,
    draw_answer,
    draw_features,
    frame_view,
    save_labels,
    views_of,
)
from emgs_jax.runs.finished_run import FinishedRun, read_run
from emgs_jax.runs.query import Question, ask, write_answer
from emgs_jax.runs.vocabulary import Vocabulary, feature_model, vocabulary, words_of

from .command import command

UNLIKE = ("object", "things", "stuff", "texture")  # LERF's canonical phrases


def query(config: DictConfig) -> dict[str, Any]:
    """Query `config.map`, write and print the answer; return what query.json says."""
    instances = build(config, "instances")
    words = asked(config)
    run = read_run(Path(config.map))
    texts = vocabulary(run, config.features.text, feature_model(config, words))
    question = Question(
        texts.embed(words), rivals(config, words, texts), float(config.margin), float(config.min_cosine), instances
    )
    views = given_views(config, run)
    folder = run.folder if config.out is None else Path(config.out)
    check_writable(folder, f"map={folder}")
    folder.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    answer = ask(run, question)
    seconds = time.perf_counter() - start
    said = write_answer(folder, run.folder, answer)
    of_words = best_views(run, answer, config.num_views) if views is None else [views] * len(words)
    count = draw_answer(folder / QUERY_PICTURE, run, answer, of_words, config.max_words)
    everywhere = views_of(run)
    chosen = views or [everywhere[len(everywhere) * (2 * i + 1) // 6] for i in range(3) if everywhere]
    draw_features(folder / FEATURES_PICTURE, run, chosen)
    if config.label_images:
        save_labels(folder / LABELS_FOLDER, run, answer, named_views(run, views))
    print("\n".join(lines_of(said, "m" if run.is_metric else "units")))
    about = said["features"]
    print(
        f"{about['num_gaussians']} Gaussians, {about['num_with_feature']} with a feature of width {about['width']}: "
        f"{about['bytes_per_gaussian']} bytes each, {about['bytes_per_gaussian_in_semantic_npz']} in semantic.npz; "
        f"asked in {seconds:.2f} s, compilation included"
    )
    print(f"everything is in {folder}; query.png shows {count} of {len(words)} words")
    return said


def asked(config: DictConfig) -> tuple[str, ...]:
    """The words to ask for, from `text` and the class file."""
    words = words_of(config.text, "text")
    words += () if config.classes is None else read_classes(config.classes).names
    if not words:
        raise ValueError("nothing is asked: give text=chair, text=[chair,table] or classes=FILE")
    return words_of(words, "text and classes")


def rivals(config: DictConfig, words: tuple[str, ...], texts: Vocabulary) -> TextEmbeddings:
    """Embed a query's rivals: the words of `against`, else all others of a fixed vocabulary, else generic words."""
    if config.against is not None:
        names = words_of(config.against, "against")
        both = sorted({*names} & {*words})
        if both:
            raise ValueError(f"against names {', '.join(both)}, which is asked for too: leave it out of one")
    else:
        names = tuple(name for name in (UNLIKE if texts.known is None else texts.known.names) if name not in words)
    return texts.embed(names) if names else TextEmbeddings((), texts.embed(words[:1]).vectors[:0], (), {})


def given_views(config: DictConfig, run: FinishedRun) -> list[View] | None:
    """The poses of `pose` or `frame`; None if the best ones are to be found."""
    if config.pose is not None and config.frame is not None:
        raise ValueError("pose and frame both say from where to draw: give one of them")
    if config.frame is not None:
        return [frame_view(run, config.frame)]
    if config.pose is None:
        return None
    if not Path(config.pose).is_file():
        raise ValueError(f"pose={config.pose} is no file: give lines `timestamp tx ty tz qx qy qz qw`")
    times, poses = load_trajectory_tum(config.pose)
    if not len(poses):
        raise ValueError(f"pose={config.pose} has no pose: give lines `timestamp tx ty tz qx qy qz qw`")
    return [View(f"pose at {time:g}", pose) for time, pose in zip(times, poses, strict=True)]


def named_views(run: FinishedRun, views: list[View] | None) -> dict[str, View]:
    """The poses to draw class images from: the given ones by number, else all frames by image name."""
    if views is not None:
        return {f"{number:06d}": view for number, view in enumerate(views)}
    rows = np.flatnonzero(run.is_placed)
    frames = [run.frames[row] for row in rows]
    names = [Path(frame["name"]).stem for frame in frames]
    if len(set(names)) < len(names):  # as with a folder for each image
        names = [f"{frame['index']:06d}" for frame in frames]
    return {name: View(name, run.poses[row]) for name, row in zip(names, rows, strict=True)}


def lines_of(said: dict[str, Any], unit: str) -> list[str]:
    """A line for each word, with its best object; lengths are in `unit`."""
    lines = []
    for found in said["words"]:
        line = f"{found['word']}: {found['num_gaussians']} Gaussians, {len(found['instances'])} objects"
        if found["instances"]:
            best = found["instances"][0]
            center, extent = (", ".join(f"{float(x):.2f}" for x in best[key]) for key in ("center_m", "extent_m"))
            line += f"; the best at ({center}) {unit}, {extent} {unit} large, cosine {best['score']:.2f}, "
            line += f"lead {best['lead']:.2f}"
        lines.append(line)
    return lines


main = command("query")(query)

if __name__ == "__main__":
    main()

"""Score the segmentation of maps as in the paper's Table III: `python -m experiments.segment 'map=[office0,room0]' …`.

Each scene has a map, compared with Replica's labelled mesh or with the labels of the data set's frames.
"""

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig

from emgs_jax.data.class_file import read_classes
from emgs_jax.evaluation.segmentation import LabelledPoints, TrueLabels, read_labelled_mesh
from emgs_jax.io.files import write_file, write_json
from emgs_jax.report.published import published
from emgs_jax.report.segmentation_table import PROTOCOL, Counting, Placement, SceneResult, score_scene, summary, table
from emgs_jax.runs.finished_run import FinishedRun, read_run
from emgs_jax.runs.images import images_of
from emgs_jax.runs.vocabulary import feature_model, vocabulary

from .command import command

FRAMES = "frames"  # value of `truth` for the labels of the data set's frames


def segment(config: DictConfig) -> tuple[dict[str, Any], str]:
    """Score the maps of a config, and write results and table; return both."""
    counting = Counting(config.num_neighbours, tuple(config.ignored))
    how = Placement(config.alignment, config.with_scale, config.icp_distance_m, config.icp_max_steps)
    runs = [read_run(Path(folder)) for folder in _listed(config.map)]
    scenes = scene_names(config, runs)
    if len({(run.folder.resolve(), scene) for run, scene in zip(runs, scenes, strict=True)}) < len(runs):
        raise ValueError(f"map={config.map} names a folder twice, whose points would count twice: give each once")
    Path(config.out).mkdir(parents=True, exist_ok=True)
    results: list[SceneResult] = []
    classes: tuple[str, ...] = ()
    for run, scene in zip(runs, scenes, strict=True):
        truth = true_points(config, run, scene)
        if classes and truth.classes != classes:
            raise ValueError(f"{run.folder} has other classes than {runs[0].folder}: score them by themselves")
        classes = truth.classes
        text = vocabulary(run, config.features.text, feature_model(config, classes)).embed(classes)
        results.append(score_scene(run, scene, truth, text.vectors, how, counting))
    found = summary(results, classes, counting, how) | {"truth": str(config.truth), "templates": text.templates}
    said = table(found, published("segmentation"))
    write_json(Path(config.out) / f"segmentation_{PROTOCOL}.json", found)
    write_file(Path(config.out) / f"segmentation_{PROTOCOL}.md", said)
    return found, said


def scene_names(config: DictConfig, runs: list[FinishedRun]) -> list[str]:
    """Names of the scenes: `scenes`, else the mapped sequences."""
    if config.scenes is None:
        return [str(run.provenance["data"]["sequence"]) for run in runs]
    names = _listed(config.scenes)
    if len(names) != len(runs):
        raise ValueError(f"scenes has {len(names)} names and map {len(runs)} folders: give one name for each map")
    return names


def true_points(config: DictConfig, run: FinishedRun, scene: str) -> LabelledPoints:
    """The true points of a scene: vertices of its mesh, or voxels that its labelled frames see."""
    if config.truth != FRAMES:
        if config.classes is None:
            raise ValueError(
                f"truth={config.truth} has ids only: give their class file, for Replica classes=eval_info.yaml of OVO"
            )
        return read_labelled_mesh(Path(str(config.truth)), scene, read_classes(config.classes))
    if config.classes is not None:
        raise ValueError("classes is the file of a mesh's ids, and truth=frames has the data set's names: leave it out")
    dataset, note = images_of(run)
    if dataset is None:
        raise ValueError(f"truth=frames: the frames of {run.folder} cannot be read again. {note}")
    labels = TrueLabels(dataset, config.voxel_m, config.max_depth_m)
    for row in range(len(dataset) if dataset.classes else 0):
        labels.append(dataset[row])
    truth = labels.points()
    if truth is None:
        raise ValueError(
            f"truth=frames: {dataset.name} {dataset.sequence} has no labelled frame with depth and pose: give "
            "truth=FOLDER with SCENE_mesh.ply and SCENE.txt"
        )
    return truth


def _listed(value: Any) -> list[str]:
    return [str(one) for one in (value if isinstance(value, ListConfig | list) else [value])]


@command("segment")
def main(config: DictConfig) -> None:
    _, said = segment(config)
    print(f"{said}\neverything is in {config.out}")


if __name__ == "__main__":
    main()

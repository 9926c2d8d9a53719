"""Replica as users have it: SCENE_mesh.ply, and SCENE.txt with an id for each of its vertices, in their order."""

from pathlib import Path

import numpy as np

from emgs_jax.data.class_file import ClassFile
from emgs_jax.evaluation.segmentation import LabelledPoints
from emgs_jax.io.ply_reader import read_vertices


def read_labelled_mesh(folder: Path, scene: str, classes: ClassFile) -> LabelledPoints:
    """The vertices of a scene with their classes, -1 = none.

    Raises:
        ValueError: a file is missing or damaged, the ids are not as many as the vertices, or one has no name.
    """
    mesh, labels = folder / f"{scene}_mesh.ply", folder / f"{scene}.txt"
    missing = [path.name for path in (mesh, labels) if not path.is_file()]
    if missing:
        raise ValueError(
            f"truth={folder} lacks {', '.join(missing)}: give the folder with SCENE_mesh.ply and SCENE.txt (an id a "
            "vertex) of Replica, or name the scenes (scenes=[office0])"
        )
    vertices = read_vertices(mesh)
    points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    ids = _ids(labels)
    if len(ids) != len(points):
        raise ValueError(
            f"{labels} has {len(ids)} labels and {mesh} {len(points)} vertices: fetch both files of the same mesh"
        )
    return LabelledPoints(points, classes.positions_of(ids, labels), classes.names)


def _ids(path: Path) -> np.ndarray:
    words = path.read_bytes().split()
    try:
        return np.array(words, dtype=f"S{max(map(len, words), default=1)}").astype(np.int64)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{path} is no list of whole numbers, one a vertex ({error}): fetch it again") from error

"""A mesh with an id a vertex, in Replica's layout; oracle: what was written, and what does not fit."""

import numpy as np
import pytest

from emgs_jax.data.class_file import ClassFile
from emgs_jax.evaluation.labelled_mesh import read_labelled_mesh
from emgs_jax.io.ply import structured, write_ply

CLASSES = ClassFile("classes.txt", ("wall", "chair"), {93: 0, 20: 1, -1: -1, 0: -1})
POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


def write_scene(folder, ids, points=POINTS):
    faces = np.array([[0, 1, 2]])
    write_ply(folder / "office0_mesh.ply", structured(points.astype(np.float32), ["x", "y", "z"]), faces)
    (folder / "office0.txt").write_text("\n".join(map(str, ids)) + "\n")


def test_every_vertex_has_the_class_of_its_id_and_a_missing_file_is_named(tmp_path):
    write_scene(tmp_path, [93, 20, -1, 93])
    found = read_labelled_mesh(tmp_path, "office0", CLASSES)
    np.testing.assert_array_equal(found.points, POINTS)
    assert found.labels.tolist() == [0, 1, -1, 0] and found.classes == ("wall", "chair")
    (tmp_path / "office0.txt").unlink()
    with pytest.raises(ValueError, match=r"lacks office0.txt: give the folder with SCENE_mesh.ply and SCENE.txt"):
        read_labelled_mesh(tmp_path, "office0", CLASSES)
    with pytest.raises(ValueError, match=r"lacks room7_mesh.ply, room7.txt: .*scenes="):
        read_labelled_mesh(tmp_path, "room7", CLASSES)


@pytest.mark.parametrize(
    ("ids", "message"),
    [
        ([93, 20, 93], r"office0.txt has 3 labels and .*office0_mesh.ply 4 vertices: fetch both files of the same"),
        ([93, 20, 93, 17], r"office0.txt: no name in classes.txt for id 17"),
        ([93, 20, 93, 255], r"office0.txt: no name in classes.txt for id 255, but for id -1: ids of 16 bits"),
        ([93, 20, 93, "wall"], r"office0.txt is no list of whole numbers"),
        ([93, 20, 93, "9" * 30], r"office0.txt is no list of whole numbers"),
    ],
)
def test_labels_that_do_not_fit_are_named(tmp_path, ids, message):
    write_scene(tmp_path, ids)
    with pytest.raises(ValueError, match=message):
        read_labelled_mesh(tmp_path, "office0", CLASSES)

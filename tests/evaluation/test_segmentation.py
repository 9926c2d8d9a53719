"""Oracles: confusion matrices and metrics worked out by hand, a loop over points, the limits."""

import numpy as np
import pytest

from emgs_jax.data.base import Frame
from emgs_jax.data.class_file import ClassFile
from emgs_jax.evaluation import segmentation
from emgs_jax.evaluation.segmentation import (
    LabelledPoints,
    SpooledLabels,
    TrueLabels,
    compare_labels,
    confusion_matrix,
    nearest_classes,
    read_labelled_mesh,
    segmentation_metrics,
    transfer_labels,
    translate,
)
from emgs_jax.io.ply import structured, write_ply

CLASSES = ClassFile("classes.txt", ("wall", "chair"), {93: 0, 20: 1, -1: -1, 0: -1})
POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
#                predicted: 0  1  2  none
CONFUSION = np.array([[6, 2, 0, 2], [1, 3, 1, 0], [0, 0, 0, 0]])


def test_pairs_are_counted_and_points_without_a_true_class_are_not():
    truth = np.array([0, 0, 0, 1, 1, -1, 3, 2])
    predicted = np.array([0, 1, -1, 1, 7, 0, 1, 0])
    np.testing.assert_array_equal(confusion_matrix(truth, predicted, 3), [[1, 1, 0, 1], [0, 1, 0, 1], [1, 0, 0, 0]])
    with pytest.raises(ValueError, match="transfer the labels first"):
        confusion_matrix(truth, predicted[:3], 3)


def test_metrics_of_a_matrix_are_those_worked_out_by_hand():
    """Class 0: IoU 6 / (10 + 7 - 6), recall .6. Class 1: 3 / (5 + 5 - 3), .6. Class 2 is only predicted: 0 and 0."""
    metrics = segmentation_metrics(CONFUSION)
    expected = {
        "miou_percent": 100 * (6 / 11 + 3 / 7 + 0) / 3,
        "fmiou_percent": 100 * (10 * 6 / 11 + 5 * 3 / 7) / 15,
        "mean_recall_percent": 100 * (0.6 + 0.6 + 0) / 3,
        "accuracy_percent": 60.0,
    }
    for name, value in expected.items():
        np.testing.assert_allclose(metrics[f"segmentation/{name}"], value, rtol=1e-12, err_msg=name)
    assert metrics["segmentation/num_points"] == 15


def test_true_points_of_an_ignored_class_do_not_count_but_points_lost_to_it_do():
    """Without class 1: class 0 has IoU 6 / (10 + 6 - 6), class 2 is not predicted any more."""
    metrics = segmentation_metrics(CONFUSION, ignored=[1])
    np.testing.assert_allclose(metrics["segmentation/miou_percent"], 60.0)
    np.testing.assert_allclose(metrics["segmentation/mean_recall_percent"], 60.0)
    assert metrics["segmentation/num_points"] == 10
    truth = np.repeat(np.arange(4), [3, 1, 7, 2])
    for answer, percent in ((truth, 100.0), (np.full_like(truth, -1), 0.0)):
        metrics = segmentation_metrics(confusion_matrix(truth, answer, 6))
        for name in ("miou", "fmiou", "mean_recall", "accuracy"):
            assert metrics[f"segmentation/{name}_percent"] == percent
    assert segmentation_metrics(np.zeros((3, 4), int))["segmentation/miou_percent"] is None


def test_a_target_takes_the_most_frequent_label_of_its_neighbours(monkeypatch):
    monkeypatch.setattr(segmentation, "_VOTED_ROWS", 7)
    rng = np.random.default_rng(1)
    points, targets = rng.uniform(size=(200, 3)), rng.uniform(size=(50, 3))
    labels = rng.integers(-1, 4, 200)
    found = transfer_labels(points, labels, targets, 5)
    for target, label in zip(targets, found, strict=True):
        distances = np.where(labels < 0, np.inf, np.linalg.norm(points - target, axis=1))
        values, counts = np.unique(labels[np.argsort(distances)[:5]], return_counts=True)
        assert label == values[counts.argmax()]  # values ascend: the smallest of the most frequent
    assert (transfer_labels(points, np.full(200, -1), targets, 5) == -1).all()
    np.testing.assert_array_equal(transfer_labels(targets[:1], np.array([3]), targets, 5), 3)


class Planes:
    """A camera one metre above the plane z = 1 of its own axes; the left half is of class 0, the right of class 1."""

    classes, intrinsics, shape = ("left", "right"), (20.0, 20.0, 9.5, 9.5), (20, 20)

    def frame(self, offset: float, depth: float = 1.0) -> Frame:
        pose = np.eye(4)
        pose[0, 3] = offset
        labels = np.repeat([[0] * 10 + [1] * 10], 20, axis=0).astype(np.int32)
        labels[0] = -1
        image = np.zeros((*self.shape, 3), np.uint8)
        return Frame(0, 0.0, "f", image, np.full(self.shape, depth, np.float32), pose, labels)


def truth_of(room: "Planes", frames: list[Frame]) -> LabelledPoints | None:
    """True labels per voxel of 5 cm of what is nearer than 5 m."""
    labels = TrueLabels(room, 0.05, 5.0)
    for frame in frames:
        labels.append(frame)
    return labels.points()


def test_voxels_of_many_frames_are_merged_on_the_way_and_are_each_once(monkeypatch):
    """Of 1,000 frames of one room they were 40 million rows, which are sorted at once: gigabytes."""
    room = Planes()
    frames = [room.frame(offset) for offset in (0.0, 0.1, 0.2, 0.3)]
    whole, labels = truth_of(room, frames), TrueLabels(room, 0.05, 5.0)
    monkeypatch.setattr(segmentation, "_MERGE_ROWS", 10)
    for number in range(30):
        labels.append(frames[number % 4])
        assert sum(map(len, labels._rows)) <= 2 * len(whole.labels) + 380
    for name in ("points", "labels"):
        np.testing.assert_array_equal(getattr(labels.points(), name), getattr(whole, name))


def test_true_points_are_the_voxels_that_a_class_is_seen_in_each_once():
    room = Planes()
    truth = truth_of(room, [room.frame(0.0), room.frame(0.0), room.frame(0.0, depth=9.0)])
    assert truth.classes == room.classes
    rows = np.column_stack([truth.points, truth.labels])
    assert len(rows) == len(np.unique(rows, axis=0)) == 380  # 19 rows of 20 pixels of 5 cm, seen twice
    np.testing.assert_allclose(truth.points[:, 2], 1.025)
    np.testing.assert_array_equal(truth.labels, truth.points[:, 0] > 0)
    holes = room.frame(0.0)
    holes.depth[5:, :] = 0.0
    np.testing.assert_allclose(truth_of(room, [holes]).points[:, 2], 1.025)
    moved = truth_of(room, [room.frame(3.0)])
    np.testing.assert_array_equal(moved.labels, moved.points[:, 0] > 3.0)
    assert truth_of(room, []) is None and truth_of(room, [room.frame(0.0, depth=9.0)]) is None


def test_classes_are_compared_by_their_names_and_one_that_the_truth_lacks_is_wrong():
    room = Planes()
    truth = truth_of(room, [room.frame(0.0)])
    found = LabelledPoints(truth.points, 2 - truth.labels, ("lamp", "right", "left"))
    assert compare_labels(found, truth, 1)["segmentation/miou_percent"] == 100.0
    lost = LabelledPoints(truth.points, np.where(truth.labels == 0, 0, 1), ("lamp", "right"))
    metrics = compare_labels(lost, truth, 1)
    assert (metrics["segmentation/miou_percent"], metrics["segmentation/accuracy_percent"]) == (50.0, 50.0)


def test_the_class_of_a_voxel_is_that_of_most_views_and_a_view_counts_once(monkeypatch):
    seen, here, there = SpooledLabels(("a", "b", "c")), [0.05, 0.05, 0.05], [-0.05, 0.05, 0.25]
    seen.append(np.array([here, here, here, there]), np.array([2, 2, 2, 0]))
    for labels in ([1, -1], [1, 0]):
        seen.append(np.array([here, there]), np.array(labels))
    seen.append(np.array([here, [np.nan, 0, 0]]), np.array([0, 0]))
    for most in (500_000, 2):  # all cells together, or each by itself
        monkeypatch.setattr("emgs_jax.evaluation.clouds.PART_ROWS", most)
        found = seen.points(0.1)
        np.testing.assert_allclose(found.points, [there, here])  # by cell
        np.testing.assert_array_equal(found.labels, [0, 1])
    assert found.classes == ("a", "b", "c") and len(SpooledLabels(("a",)).points(0.1).labels) == 0


def test_classes_of_many_views_are_counted_a_range_of_cells_at_a_time(monkeypatch):
    """Of 1,000 frames the pairs of all views were sorted at once: gigabytes."""
    rng, sizes, whole = np.random.default_rng(0), [], segmentation.most_seen
    seen, found = SpooledLabels(tuple("abcd")), []
    for _ in range(20):
        seen.append(rng.uniform(-5.0, 5.0, (500, 3)), rng.integers(0, 4, 500))
    monkeypatch.setattr(segmentation, "most_seen", lambda rows: sizes.append(len(rows)) or whole(rows))
    for most in (500, 500_000):
        monkeypatch.setattr("emgs_jax.evaluation.clouds.PART_ROWS", most)
        found.append(seen.points(0.5))
    assert len(sizes) == 21 and max(sizes[:-1]) < 1500 and sum(sizes[:-1]) == sizes[-1]
    np.testing.assert_array_equal(found[0].points, found[1].points)
    np.testing.assert_array_equal(found[0].labels, found[1].labels)


def test_labels_are_translated_by_name_and_the_nearest_class_is_by_angle():
    """A class that the others lack stays an answer; a missing feature has none."""
    found = translate(np.array([[0, 1], [2, -1]]), ("chair", "wall", "cat"), ("wall", "chair"))
    np.testing.assert_array_equal(found, [[1, 0], [2, -1]])
    features = np.array([[[5.0, 1.0], [0.0, 0.0], [0.1, 0.2]]], np.float16)
    np.testing.assert_array_equal(nearest_classes(features, np.array([[3.0, 0], [0, 1.0]])), [[0, -1, 1]])


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

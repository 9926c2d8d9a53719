"""The three protocols; oracle: one small map whose matrices and numbers are counted by hand, and single rules."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hydra.utils import instantiate

from emgs_jax.config.configure import build, compose
from emgs_jax.evaluation.protocols import (
    NAMES,
    give_classes,
    ignored_positions,
    matrix_metrics,
    scene_confusion,
    table_metrics,
    voxel_labels,
)
from emgs_jax.evaluation.segmentation import LabelledPoints

CLASSES = ("wall", "chair", "table", "lamp")


@cache
def composed(name: str):
    config = compose(f"protocol={name}", "map=x", "truth=x", name="segment").protocol
    return instantiate(config, _convert_="all")


def protocol(name: str, **changes):
    return replace(composed(name), **changes)


def scene() -> tuple[np.ndarray, np.ndarray, LabelledPoints]:
    """Places along x, a metre apart; the map's cosines with the classes, and its truth.

    Each place has five Gaussians within 3 mm and one true point, or at 0 m two. So the five that vote are the place's.
    Gaussian's classes by place: 0: wall ×5; 1: chair ×3, table ×2; 2: table ×4, one without a feature;
    3: lamp ×2, chair ×1, two without; 4: wall ×3, chair ×2. The true classes: wall twice, chair, chair, table, none.
    """
    given = [[0] * 5, [1, 1, 1, 2, 2], [2, 2, 2, 2, -1], [3, 3, 1, -1, -1], [0, 0, 0, 1, 1]]
    offsets = np.array([-2, -1, 0, 1, 2]) * 1e-3
    points = np.array([[place + offset, 0.0, 0.0] for place in range(5) for offset in offsets])
    labels = np.array(given).ravel()
    cosines = np.where(labels[:, None] == np.arange(4), 0.9, 0.1)
    cosines[labels < 0] = 0.0
    true = np.array([[0.0, 0, 0], [0.0, 1e-4, 0], [1.0, 0, 0], [2.0, 0, 0], [3.0, 0, 0], [4.0, 0, 0]])
    return points, cosines, LabelledPoints(true, np.array([0, 0, 1, 1, 2, -1]), CLASSES)


def score(name: str, **changes) -> tuple[np.ndarray, dict[str, float | None]]:
    points, cosines, truth = scene()
    p = protocol(name, **changes)
    ignored = ignored_positions(CLASSES, p)
    labels = give_classes(cosines, cosines.any(1), truth.labels, ignored, p)
    confusion = scene_confusion(LabelledPoints(points, labels, CLASSES), truth, ignored, p)
    return confusion, matrix_metrics(confusion, ignored, p)


def assert_numbers(found, miou, fmiou, acc):
    np.testing.assert_allclose([found[name] for name in NAMES], [100 * miou, 100 * fmiou, 100 * acc], rtol=1e-9)


def test_ovo_counts_by_hand():
    """Vertices: wall → wall twice; chair → chair; chair → table; table → lamp (2 of 3 with a feature, and two more
    neighbours with a feature are a metre off: wall and chair tie with nothing, lamp has most). Unknown: not counted.

    IoU: wall 2/2, chair 1/2, table 0/2, lamp 0/1 (only predicted: counts, with recall 0).
    """
    confusion, found = score("ovo")
    np.testing.assert_array_equal(confusion, [[2, 0, 0, 0, 0], [0, 1, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 0]])
    assert_numbers(found, (1 + 1 / 2 + 0 + 0) / 4, (2 * 1 + 2 * 0.5 + 1 * 0) / 5, (1 + 1 / 2 + 0 + 0) / 4)


def test_rayfronts_counts_by_hand():
    """Wall is ignored: no prompt, and its true points do not count. Gaussians of wall have equal cosines with all
    others: each class has 1/3 ≥ .1, so they take the first, chair. Voxels: 0: chair; 1: chair; 2: table; 3: lamp and
    none tie (2 : 2 : 1), so none; 4: chair.

    k = 5 takes all five voxels for every true voxel: three chair, one table, one none: chair. True voxels: 0 none
    (wall), 1 chair, 2 chair, 3 table. IoU: chair 2/3, table 0/1; lamp is not true. Overall 2 of 3.
    """
    confusion, found = score("rayfronts")
    np.testing.assert_array_equal(confusion, [[0, 0, 0, 0, 0], [0, 2, 0, 0, 0], [0, 1, 0, 0, 0], [0, 0, 0, 0, 0]])
    assert_numbers(found, (2 / 3 + 0) / 2, (2 * (2 / 3) + 0) / 3, 2 / 3)


def test_conceptgraphs_counts_by_hand():
    """Offered: wall, chair, table, which the scene has. The two lamps have equal cosines with them: the first, wall.

    Gaussians by their nearest true point: 0 (wall): wall ×5. 1 (chair): chair ×3, table ×2. 2 (chair): table ×4, none.
    3 (table): wall ×2, chair ×1, none ×2. 4: unknown. IoU: wall 5/7, chair 3/(10 + 4 - 3), table 0.
    """
    confusion, found = score("conceptgraphs")
    np.testing.assert_array_equal(confusion, [[5, 0, 0, 0, 0], [0, 3, 6, 0, 1], [2, 1, 0, 0, 2], [0, 0, 0, 0, 0]])
    assert_numbers(found, (5 / 7 + 3 / 11 + 0) / 3, (5 * 5 / 7 + 10 * 3 / 11 + 5 * 0) / 20, (5 / 5 + 3 / 10 + 0) / 3)


def test_a_class_that_no_point_of_the_map_meets_is_left_out_of_conceptgraphs_matrix():
    """Its column, too: what was given to it is not even a miss."""
    confusion = np.array([[3, 1, 0], [0, 0, 0]])
    assert matrix_metrics(confusion, [], protocol("conceptgraphs"))["miou"] == 100.0
    assert matrix_metrics(confusion, [], protocol("rayfronts"))["miou"] == 75.0


def test_background_that_ovo_ignores_stays_a_prompt():
    _, cosines, truth = scene()
    p = protocol("ovo", ignored=["wall", "door"])
    ignored = ignored_positions(CLASSES, p)
    assert ignored == [0]
    assert (give_classes(cosines, cosines.any(1), truth.labels, ignored, p)[:5] == 0).all()
    kept = replace(p, offered="kept")
    assert (give_classes(cosines, cosines.any(1), truth.labels, ignored, kept) != 0).all()
    confusion, found = score("ovo", ignored=["wall"])
    assert confusion[0].sum() == 0
    np.testing.assert_allclose(found["miou"], 100 * (1 / 2 + 0 + 0) / 3)


def test_unsure_points_and_classes_that_are_sure_nowhere_have_no_answer():
    """Softmax of 100 · cosine: a lead of .1 is e¹⁰ : 1; of .005 it is .62 : .38."""
    p = replace(protocol("rayfronts"), ignored=[])
    cosines = np.array([[0.5, 0.4, 0.0], [0.3, 0.305, 0.0], [0.2, 0.2, 0.2]])
    known = np.ones(3, bool)

    def given(**changes):
        return give_classes(cosines, known, np.arange(3), [], replace(p, **changes)).tolist()

    assert given(min_probability=0.0, min_class_probability=0.0) == [0, 1, 0]
    assert given(min_probability=0.5, min_class_probability=0.0) == [0, 1, -1]
    assert given(min_probability=0.63, min_class_probability=0.0) == [0, -1, -1]
    # Class 1 has .62 at best, class 2 has .33: the first point keeps its class, the second has .38 of class 0.
    assert given(min_probability=0.3, min_class_probability=0.63) == [0, 0, 0]
    assert given(min_probability=0.4, min_class_probability=0.63) == [0, -1, -1]
    assert give_classes(cosines, np.array([True, False, True]), np.arange(3), [], p)[1] == -1
    assert (give_classes(cosines, known, np.arange(3), [0, 1, 2], p) == -1).all()


def test_a_voxel_has_its_most_frequent_label_and_none_wins_a_tie():
    points = np.array([[0.02, 0, 0], [-0.02, 0, 0], [0.01, 0, 0], [0.98, 0, 0], [1.02, 0, 0], [2.0, 0, 0]])
    centers, labels = voxel_labels(points, np.array([2, 2, 1, 3, -1, 0]), 0.05)
    order = np.argsort(centers[:, 0])
    np.testing.assert_allclose(centers[order][:, 0], [0.0, 1.0, 2.0])
    assert labels[order].tolist() == [2, -1, 0]
    same = voxel_labels(points, np.arange(6), 0.0)
    np.testing.assert_array_equal(same[0], points)


def test_scenes_are_added_or_averaged():
    first, second = np.array([[8, 0, 0], [2, 0, 0]]), np.array([[0, 0, 0], [0, 4, 0]])
    ovo = table_metrics([first, second], [], protocol("ovo"))
    np.testing.assert_allclose(ovo["miou"], 100 * (8 / 10 + 4 / 6) / 2)
    rayfronts = table_metrics([first, second], [], protocol("rayfronts"))
    np.testing.assert_allclose(rayfronts["miou"], (100 * (8 / 10 + 0) / 2 + 100) / 2)
    np.testing.assert_allclose(rayfronts["acc"], (80 + 100) / 2)
    assert table_metrics([np.zeros((2, 3), int)], [], protocol("ovo"))["miou"] is None


def test_points_without_a_class_vote_for_none_where_the_protocol_says_so_and_other_classes_are_refused():
    """Three of the five nearest have none, two are chairs."""
    points = np.array([[0.01 * i, 0.0, 0.0] for i in range(5)])
    found = LabelledPoints(points, np.array([-1, 1, -1, 1, -1]), CLASSES)
    truth = LabelledPoints(points[:1], np.array([1]), CLASSES)
    for none_votes, column in ((True, 4), (False, 1)):
        p = protocol("rayfronts", voxel_m=0.0, none_votes=none_votes)
        assert scene_confusion(found, truth, [], p)[1].tolist() == [int(i == column) for i in range(5)]
    with pytest.raises(ValueError, match=r"protocol.compared_at must be one of truth, map; got 'mesh'"):
        build(compose("protocol.compared_at=mesh", "map=x", "truth=x", name="segment"), "protocol")
    with pytest.raises(ValueError, match="same classes"):
        scene_confusion(replace(found, classes=("sofa",)), truth, [], protocol("ovo"))

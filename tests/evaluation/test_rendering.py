"""Rendered views against frames; oracles: numbers that are worked out by hand."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from hand_run import poses_along
from scene import evaluation_config

from emgs_jax.data.base import Frame
from emgs_jax.evaluation.rendering import Rendered, depth_scale, rendering_metrics, score_view

INF = float("inf")
SHAPE = (4, 6)


def a_frame(depth=2.0, index=0, gray=51):
    image = np.full((*SHAPE, 3), gray, np.uint8)
    return Frame(index, 0.0, "f", image, None if depth is None else np.full(SHAPE, depth, np.float32))


def metrics_of(frame, depth, colors=None, scale=1.0, max_depth=INF):
    return rendering_metrics([score_view(frame, depth, colors, scale, max_depth)])


def half(value):
    """Depth on the left half of the image, none on the right."""
    depth = np.full(SHAPE, value, np.float32)
    depth[:, 3:] = 0.0
    return depth


def test_a_plane_at_two_metres_of_which_half_is_rendered_five_centimetres_behind_it():
    metrics = metrics_of(a_frame(), half(2.05), np.full((*SHAPE, 3), 0.3))
    assert metrics["rendering/coverage_percent"] == metrics["rendering/worst_coverage_percent"] == 50.0
    assert metrics["rendering/depth_within_5_percent"] == 50.0, "what is not rendered is not within"
    assert metrics["rendering/depth_l1_m"] == pytest.approx(0.05, abs=1e-6)  # float32
    assert metrics["rendering/psnr_db"] == pytest.approx(20.0)  # an error of .1 everywhere
    assert metrics["rendering/num_frames"] == 1
    for depth, within in ((1.89, 0.0), (1.91, 100.0), (2.09, 100.0), (2.11, 0.0)):  # of the true depth
        assert metrics_of(a_frame(), np.full(SHAPE, depth))["rendering/depth_within_5_percent"] == within


def test_the_depth_is_brought_to_metres_by_the_scale_of_the_alignment():
    metrics = metrics_of(a_frame(), np.full(SHAPE, 0.5), scale=4.0)
    assert metrics["rendering/depth_l1_m"] == 0.0 and metrics["rendering/depth_within_5_percent"] == 100.0
    truth = poses_along([0.0, 1.0, 3.0])
    poses = truth.copy()
    poses[:, :3, 3] *= 0.25
    assert depth_scale((poses, truth), evaluation_config()) == pytest.approx(4.0)
    assert depth_scale((poses, truth), evaluation_config("evaluation.alignment=se3")) == 1.0


def test_pixels_without_a_true_depth_and_beyond_the_farthest_one_do_not_count():
    frame = a_frame()
    frame.depth[0], frame.depth[1] = 0.0, 9.0
    depth, colors = np.full(SHAPE, 2.0), np.full((*SHAPE, 3), 0.2)
    depth[:2], colors[:2] = 0.0, 1.0
    metrics = metrics_of(frame, depth, colors, max_depth=5.0)
    assert metrics["rendering/coverage_percent"] == 100.0 and metrics["rendering/depth_l1_m"] == 0.0
    assert metrics["rendering/psnr_db"] > 100.0
    assert metrics_of(frame, depth, colors)["rendering/coverage_percent"] == pytest.approx(100.0 * 2 / 3)


def test_means_are_over_frames_and_what_is_no_depth_is_not_covered_and_has_no_error():
    for poison in (float("nan"), INF, -1.0):
        depth = half(2.0)
        depth[:, 3:] = poison
        assert metrics_of(a_frame(), depth) == metrics_of(a_frame(), half(2.0))
    views = [np.full(SHAPE, 2.0), half(2.2), np.zeros(SHAPE)]
    metrics = rendering_metrics([score_view(a_frame(), depth, None, 1.0, INF) for depth in views])
    assert metrics["rendering/coverage_percent"] == pytest.approx(50.0)
    assert metrics["rendering/worst_coverage_percent"] == 0.0
    assert metrics["rendering/depth_l1_m"] == pytest.approx(0.1, abs=1e-6)  # of 0 and .2
    assert metrics["rendering/depth_within_5_percent"] == pytest.approx(100.0 / 3)
    assert metrics["rendering/psnr_db"] is None, "no colours were rendered"


def test_the_psnr_is_of_all_covered_pixels_together():
    """24 pixels with an error of .1 and 12 with one of .4: (24 · .01 + 12 · .16) / 36 = .06."""
    colors = np.full((*SHAPE, 3), 0.2)
    views = [(np.full(SHAPE, 2.0), colors + 0.1), (half(2.0), colors + 0.4)]
    metrics = rendering_metrics([score_view(a_frame(), *view, 1.0, INF) for view in views])
    assert metrics["rendering/psnr_db"] == pytest.approx(-10.0 * np.log10(0.06))


def test_frames_without_true_depth_do_not_count_and_without_any_truth_nothing_is_defined():
    assert score_view(a_frame(None), np.ones(SHAPE), None, 1.0, INF) is None
    assert score_view(a_frame(0.0), np.ones(SHAPE), None, 1.0, INF) is None
    metrics = rendering_metrics([None])
    assert metrics.pop("rendering/num_frames") == 0 and set(metrics.values()) == {None}
    blind = SimpleNamespace(has_ground_truth=False)
    for dataset, poses in ((blind, (poses_along([0.0]), poses_along([0.0]))), (Planes(), None)):
        rendered = Rendered(dataset, poses, evaluation_config())
        rendered.add(0, np.ones(SHAPE), None)
        assert rendered.metrics() == {}


class Planes:
    """Three frames, one of each plane; the poses are a metre apart."""

    has_ground_truth = True

    def __len__(self):
        return 3

    def __getitem__(self, row):
        return a_frame(2.0 + row, row)


def rendered_of(config=None, **depths):
    """Of the planes, of which these frames are added."""
    truth = poses_along([0.0, 1.0, 3.0])
    rendered = Rendered(Planes(), (truth, truth), config or evaluation_config())
    for name, depth in depths.items():
        rendered.add(int(name[1:]), depth, None)
    return rendered.metrics()


def test_frames_that_are_not_added_are_lost_and_covered_nowhere_and_the_farthest_depth_is_the_protocols():
    metrics = rendered_of(_2=np.full(SHAPE, 4.0), _0=np.full(SHAPE, 2.0))
    assert metrics["rendering/num_frames"] == 3
    for name in ("coverage_percent", "depth_within_5_percent"):
        assert metrics[f"rendering/{name}"] == pytest.approx(200.0 / 3), name
    assert metrics["rendering/worst_coverage_percent"] == 0.0
    assert metrics["rendering/depth_l1_m"] == pytest.approx(0.0, abs=1e-12)
    near = dataclasses.replace(evaluation_config(), max_depth_m=3.5)
    metrics = rendered_of(near, _0=half(2.0), _1=half(3.0))
    assert metrics["rendering/num_frames"] == 2 and metrics["rendering/coverage_percent"] == 50.0


def test_classes_of_rendered_pixels_are_counted_over_all_frames_and_a_lost_one_has_none_right():
    """Two frames of the classes 0 and 1, half each: one rendered with a quarter wrong, one lost; 9 of 24 are right."""

    class Labelled(list):
        classes, has_ground_truth = ("wall", "box"), True

    labels = np.zeros(SHAPE, np.int32)
    labels[:, 3:] = 1
    frames = Labelled(dataclasses.replace(a_frame(index=i), labels=labels) for i in (0, 1))
    for frame in frames:
        frame.labels[0] = -1  # without a true class: these say nothing
    poses = poses_along([0.0, 1.0])
    rendered = Rendered(frames, (poses, poses), evaluation_config(), has_classes=True)
    found = labels.copy()
    found[1:, :2] = [[1, -1]] * 3  # six of eighteen: a wrong answer or none
    rendered.add(0, np.full(SHAPE, 2.0), None, found)
    metrics = rendered.metrics()
    assert metrics["rendering/label_accuracy_percent"] == pytest.approx(100 * 12 / 36)
    # wall: 3 right of 18 true, none but these predicted; box: 9 right, 18 true and 3 that are wall.
    assert metrics["rendering/label_miou_percent"] == pytest.approx(100 * (3 / 18 + 9 / 21) / 2)
    plain = Rendered(frames, (poses, poses), evaluation_config())
    plain.add(0, np.full(SHAPE, 2.0), None)
    assert plain.metrics()["rendering/label_accuracy_percent"] is None

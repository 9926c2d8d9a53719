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


def test_the_metrics_are_those_of_a_loop_over_pixels():
    """Frames with holes and far pixels, rendered a quarter as large, with holes and what is no depth in them."""
    rng, views, whole = np.random.default_rng(0), [], {"coverage": [], "within": [], "l1": [], "squares": []}
    for number in range(3):
        frame = a_frame(2.0, gray=40 * number)
        frame.depth[:] = rng.choice([0.0, 1.0, 2.0, 9.0], SHAPE)
        depth = frame.depth / 4 * rng.choice([0.0, 0.94, 0.96, 1.04, 1.06], SHAPE)
        depth[0, :3] = np.nan, INF, -1.0
        colors = rng.uniform(size=(*SHAPE, 3))
        views.append(score_view(frame, depth, colors, 4.0, 5.0))
        known, covered, errors = 0, 0, []
        for place in np.ndindex(SHAPE):
            if 0 < frame.depth[place] <= 5.0:
                known += 1
                if np.isfinite(depth[place]) and depth[place] > 0:
                    covered += 1
                    errors.append((abs(4 * depth[place] - frame.depth[place]), frame.depth[place]))
                    whole["squares"] += [*(colors[place] - frame.image[place] / 255) ** 2]
        whole["coverage"].append(100 * covered / known)
        whole["within"].append(100 * sum(error <= 0.05 * true for error, true in errors) / known)
        whole["l1"].append(np.mean([error for error, _ in errors]))
    found = rendering_metrics([*views, score_view(a_frame(2.0), None, None, 4.0, 5.0)])  # one is lost
    expected = {"coverage_percent": sum(whole["coverage"]) / 4, "depth_within_5_percent": sum(whole["within"]) / 4}
    expected |= {"worst_coverage_percent": 0.0, "num_frames": 4, "depth_l1_m": np.mean(whole["l1"])}
    expected |= {"psnr_db": -10 * np.log10(np.mean(whole["squares"]))}
    for name, value in expected.items():
        np.testing.assert_allclose(found[f"rendering/{name}"], value, rtol=1e-5, err_msg=name)  # of float32
    assert len(whole["l1"]) == 3 and 0 < whole["within"][0] < whole["coverage"][0] < 100
    plain = rendering_metrics([score_view(a_frame(), np.full(SHAPE, 2.0), None, 1.0, INF)])
    assert plain["rendering/psnr_db"] is None, "no colours were rendered"


def test_the_scale_of_a_depth_is_that_of_the_alignment():
    truth = poses_along([0.0, 1.0, 3.0])
    poses = truth.copy()
    poses[:, :3, 3] *= 0.25
    assert depth_scale((poses, truth), evaluation_config()) == pytest.approx(4.0)
    assert depth_scale((poses, truth), evaluation_config("evaluation.alignment=se3")) == 1.0


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
    metrics = rendered_of(near, _0=np.full(SHAPE, 2.0))
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

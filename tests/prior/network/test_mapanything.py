"""The prior around a network with MapAnything's documented contract; oracle: the geometry that the double draws."""

import json
from dataclasses import fields, replace

import hydra
import numpy as np
import pytest
from network_double import Double, Sphere, network_of
from tiny_run import compose

from emgs_jax.prior.base import Prior, relative_poses, windows

pytestmark = pytest.mark.slow  # many small executables: most of the time is compilation

WINDOW_SIZE, GRID = 3, "[56,42]"


def make(double, *overrides):
    """The prior of conf/prior/mapanything.yaml around a double."""
    config = compose("prior=mapanything", f"prior.resolution={GRID}", *(f"prior.{o}" for o in overrides)).prior
    return hydra.utils.instantiate(config, load=lambda *_: network_of(double))


def ask(prior, data, window):
    return prior.predict(window, [data[i] for i in window.views], data.intrinsics)


def calls(data):
    return list(windows(range(len(data)).__contains__, WINDOW_SIZE))


def same_bits(a, b):
    assert not a.adjusted and not b.adjusted
    names = [field.name for field in fields(a) if field.name not in ("window", "adjusted")]
    pairs = [(getattr(a, name), getattr(b, name)) for name in names]
    return all(one is other is None or one.tobytes() == other.tobytes() for one, other in pairs)


def frame_matrix(data):
    fx, fy, cx, cy = data.intrinsics
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


@pytest.mark.parametrize("size", [(56, 42), (40, 30), (120, 90)])
def test_world_points_lie_where_the_frames_pixels_look_from_poses_relative_to_the_anchor(size):
    """With the true pose of the anchor everything is in the true world, though the network's frame is another."""
    data = Sphere(size=size)
    prior = make(Double(data), "anchor_pose=off", "masks.max_edge_step=inf")
    for window in calls(data):
        prediction = ask(prior, data, window)
        assert prediction.points.shape == (len(window.dense), *size[::-1], 3)
        assert prediction.mask.all()
        true = relative_poses([data.pose(index) for index in window.views])
        true[:, :3, 3] *= 1.1  # no metric flag, so the default is True
        np.testing.assert_array_equal(prediction.T_anchor_view[0], np.eye(4))
        np.testing.assert_allclose(prediction.T_anchor_view, true, atol=2e-6)  # the network speaks float32
        for index, points in zip(window.dense, prediction.points, strict=True):
            depth = 1.1 * data.depth(index, frame_matrix(data), size)
            v, u = np.indices(depth.shape)
            local = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(frame_matrix(data)).T * depth[..., None]
            # Exact on the grid; between its pixels the sphere bends (5 cm a pixel, radius 3 m), at the rim the nearest.
            inner = np.linalg.norm(points - local, axis=-1)[2:-2, 2:-2]
            assert inner.max() < (1e-5 if size == (56, 42) else 2e-3)


@pytest.mark.parametrize(
    ("overrides", "anchor_keys", "scale"),
    [
        ((), {"camera_poses", "is_metric_scale"}, 1.05),
        (("anchor_is_metric=true",), {"camera_poses", "is_metric_scale"}, 1.05 * 1.1),
        (("anchor_pose=off",), set(), 1.1),
    ],
)
def test_the_anchors_pose_and_its_flag_are_switches_that_reach_the_network(overrides, anchor_keys, scale):
    data = Sphere(size=(56, 42))
    double = Double(data)
    prior = make(double, *overrides)
    window = calls(data)[1]
    prediction = ask(prior, data, window)
    base = {"img", "data_norm_type", "intrinsics"}
    assert double.seen == [base | anchor_keys] + [base] * (len(window.views) - 1)
    depth = data.depth(window.dense[0], frame_matrix(data), (56, 42))
    np.testing.assert_allclose(prediction.points[0][..., 2], scale * depth, rtol=1e-5)
    settings = json.loads(json.dumps(prior.provenance.settings))
    assert settings["masks"]["max_edge_step"] == 0.03
    assert settings["anchor_pose"] is bool(anchor_keys)
    assert settings["anchor_is_metric"] == (("anchor_is_metric=true" in overrides) if anchor_keys else None)
    assert isinstance(prior, Prior) and make(Double(data)).report() == {}
    report = prior.report()
    assert report["prior/num_inferences"] == 1 and report["prior/peak_gpu_mib"] == 3
    assert 0 < report["prior/seconds_per_inference"] < 10


def test_a_prediction_depends_on_its_images_alone():
    """Asked again, after other windows and by another object, it gives the same bits."""
    data = Sphere(num_frames=6)
    whole = make(Double(data))
    first = [ask(whole, data, window) for window in calls(data)]
    for window, prediction in list(zip(calls(data), first, strict=True))[::2]:
        assert same_bits(ask(whole, data, window), prediction)
        blind = [replace(data[i], T_world_camera=None) for i in window.views]
        assert same_bits(make(Double(data)).predict(window, blind, data.intrinsics), prediction)
    other = [replace(data[i], image=data[(i + 1) % 6].image) for i in window.views]  # frames of the same numbers
    again, anew = (prior.predict(window, other, data.intrinsics) for prior in (whole, make(Double(data))))
    assert same_bits(again, anew) and not same_bits(again, prediction)


def cloudy(index, output):
    output["non_ambiguous_mask"][:, :10] = False
    output["pts3d_cam"][:, :5] = np.nan


def bare(index, output):
    del output["conf"], output["non_ambiguous_mask"]


def spoiled(spoil, *overrides, number=1, size=(56, 42)):
    data = Sphere(size=size)
    return ask(make(Double(data, spoil=spoil), *overrides), data, calls(data)[number])


def test_what_is_ambiguous_is_masked_and_has_no_point():
    found = spoiled(cloudy)
    assert not found.mask[:, :10].any() and found.mask[:, 12:].all()
    assert not found.points[~found.mask].any() and (found.confidence[~found.mask] == 1).all()
    assert np.isfinite(found.points).all() and found.confidence.min() >= 1
    sure = spoiled(bare)  # without confidence and ambiguity
    assert sure.mask.all() and (sure.confidence == 1).all()


def test_outputs_and_frames_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="no pts3d_cam, camera_poses"):
        spoiled(lambda i, o: (o.pop("pts3d_cam"), o.pop("camera_poses")))
    with pytest.raises(ValueError, match=r"images of \(56, 42\) and answered with points of \(28, 21\)"):
        spoiled(lambda index, output: output.update(pts3d_cam=output["pts3d_cam"][:, ::2, ::2]))
    data, other = Sphere(), Sphere(size=(44, 30))
    frames, window, prior = [data[0], data[1], other[2]], calls(data)[0], make(Double(data))
    with pytest.raises(ValueError, match=r"must have one size .*got \[\(40, 30\), \(44, 30\)\]"):
        prior.predict(window, frames, data.intrinsics)
    with pytest.raises(ValueError, match="in that order"):
        prior.predict(window, frames[::-1], data.intrinsics)

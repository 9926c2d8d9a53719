"""The prior around a network with MapAnything's documented contract; oracle: the geometry that the double draws."""

import json
from dataclasses import fields, replace

import hydra
import numpy as np
import pytest
from network_double import Double, DrawnRoom, Sphere, check_views, network_of
from scene import slam_config
from tiny_run import compose, dataset

from emgs_jax.prior.base import Prior, windows
from emgs_jax.prior.network import mapanything
from emgs_jax.prior.network.framework import MODELS, build_views
from emgs_jax.prior.network.mapanything import relative_poses
from emgs_jax.prior.network.resize import plan_resize, resize_image
from emgs_jax.prior.recorded import Recorded, record
from emgs_jax.running.convert import to_first_window

pytestmark = pytest.mark.slow  # many small executables: most of the time is compilation

WINDOW_SIZE, GRID = 3, "[56,42]"


def make(double, *overrides):
    """The prior of conf/prior/mapanything.yaml around a double."""
    config = compose("prior=mapanything", f"prior.resolution={GRID}", *(f"prior.{o}" for o in overrides)).prior
    return hydra.utils.instantiate(config, load=lambda settings: network_of(double))


def ask(prior, data, window):
    return prior.predict(window, [data[i] for i in window.views], data.intrinsics)


def calls(data):
    return list(windows(len(data), WINDOW_SIZE))


def same_bits(a, b):
    names = [field.name for field in fields(a) if field.name != "window"]
    return all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in names)


def frame_matrix(data):
    fx, fy, cx, cy = data.intrinsics
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


@pytest.mark.parametrize("size", [(56, 42), (40, 30), (120, 90)])
def test_world_points_lie_where_the_frames_pixels_look(size):
    """With the true pose of the anchor everything is in the true world, though the network's frame is another."""
    data = Sphere(size=size)
    prior = make(Double(data), "anchor_pose=off", "masks.max_edge_step=inf")
    for window in calls(data):
        prediction = ask(prior, data, window)
        assert prediction.points.shape == (len(window.dense), *size[::-1], 3)
        assert prediction.mask.all()
        for index, points in zip(window.dense, prediction.points, strict=True):
            T_world_view = data.pose(0) @ prediction.T_anchor_view[window.views.index(index)]
            got = points @ T_world_view[:3, :3].T + T_world_view[:3, 3]
            depth = 1.1 * data.depth(index, frame_matrix(data), size)  # 1.1: no metric flag, so the default is True
            v, u = np.indices(depth.shape)
            local = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(frame_matrix(data)).T * depth[..., None]
            T_scaled = data.pose(0) @ scaled(np.linalg.inv(data.pose(0)) @ data.pose(index), 1.1)
            expected = local @ T_scaled[:3, :3].T + T_scaled[:3, 3]
            # Exact on the grid; between its pixels the sphere bends (5 cm a pixel, radius 3 m), at the rim the nearest.
            inner = np.linalg.norm(got - expected, axis=-1)[2:-2, 2:-2]
            assert inner.max() < (1e-5 if size == (56, 42) else 2e-3)


def scaled(T, factor):
    T = T.copy()
    T[:3, 3] *= factor
    return T


def test_poses_are_relative_to_the_anchor_though_the_networks_own_frame_is_not_its_camera():
    data = Sphere()
    prior = make(Double(data), "anchor_is_metric=true")
    for window in calls(data):
        got = ask(prior, data, window).T_anchor_view
        expected = relative_poses([data.pose(index) for index in window.views])
        expected[:, :3, 3] *= 1.1 * 1.05
        np.testing.assert_array_equal(got[0], np.eye(4))
        np.testing.assert_allclose(got, expected, atol=2e-6)  # the network speaks float32


def test_on_the_networks_own_grid_nothing_is_resampled():
    data, given = Sphere(size=(56, 42)), {}
    prior = make(Double(data, spoil=lambda index, output: given.update({index: output["pts3d_cam"][0].copy()})))
    window = calls(data)[0]
    for index, points in zip(window.dense, ask(prior, data, window).points, strict=True):
        np.testing.assert_array_equal(points, given[index])


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
    settings = prior.provenance.settings
    assert settings["masks"]["max_edge_step"] == 0.03
    assert settings["anchor_pose"] is bool(anchor_keys)
    assert settings["anchor_is_metric"] == (("anchor_is_metric=true" in overrides) if anchor_keys else None)


@pytest.mark.parametrize(
    ("spoil", "error", "text"),
    [
        (lambda views: views[1].update(data_norm_type="dinov2"), AssertionError, "dinov2"),
        (lambda views: views[1].update(intrinsics=np.eye(3)[None]), RuntimeError, "dtypes"),
        (lambda views: views[1].update(K=np.eye(3)), ValueError, "invalid keys"),
        (lambda views: views[1].update(img=views[1]["img"][..., :50]), AssertionError, "divisible"),
        (lambda views: views[1].update(img=views[1]["img"][..., :42]), RuntimeError, "equal size"),
        (lambda views: views[1].update(camera_poses=views[0].pop("camera_poses")), ValueError, "view 0"),
    ],
)
def test_views_keep_the_contract_and_one_step_aside_breaks_it(spoil, error, text):
    data = Sphere()
    resize = plan_resize((40, 30), (56, 42))
    images = [resize_image(data[index].image, resize) for index in range(2)]
    views = build_views(images, data.intrinsics, resize, MODELS["mapanything"], False)
    check_views(views)
    spoil(views)
    with pytest.raises(error, match=text):
        check_views(views)


def test_an_image_is_resized_once_while_it_stays_in_the_window(monkeypatch):
    data, resized = Sphere(num_frames=6), []

    def counted(image, resize):
        resized.append(int(image[0, 0, 0]))
        return resize_image(image, resize)

    monkeypatch.setattr(mapanything, "resize_image", counted)
    prior = make(Double(data))
    for window in calls(data):
        ask(prior, data, window)
    assert sorted(resized) == list(range(6))
    other = [replace(data[i], image=data[(i + 1) % 6].image) for i in window.views]
    prior.predict(window, other, data.intrinsics)  # frames of the same numbers
    assert len(resized) == 6 + len(other)


def test_no_mask_is_made_that_nobody_asks_for(monkeypatch):
    made, usable = [], mapanything._usable
    monkeypatch.setattr(mapanything, "_usable", lambda *arguments: made.append(1) or usable(*arguments))
    data = Sphere()
    window = calls(data)[2]
    assert 0 not in window.dense
    ask(make(Double(data)), data, window)
    assert len(made) == len(window.dense)
    ask(make(Double(data), "model=vggt"), data, window)
    assert len(made) == 2 * len(window.dense) + 1  # the anchor's median depth is the unit


def test_the_truth_of_the_frames_is_not_looked_at():
    data, blind = Sphere(), Sphere()
    window = calls(data)[1]
    frames = [replace(blind[i], T_world_camera=None) for i in window.views]
    assert same_bits(make(Double(data)).predict(window, frames, data.intrinsics), ask(make(Double(data)), data, window))


@pytest.mark.parametrize("model", ["mapanything", "vggt"])
def test_a_prediction_depends_on_its_window_alone(model):
    """Asked again, after other windows and by another object, it gives the same bits; the unit of the call may vary."""
    data = Sphere(num_frames=6)
    units = (lambda call: 2.0**call) if model == "vggt" else (lambda call: 1.0)  # powers of 2 round alike
    whole = make(Double(data, unit=units), f"model={model}")
    first = [ask(whole, data, window) for window in calls(data)]
    for window, prediction in zip(calls(data), first, strict=True):
        assert same_bits(ask(whole, data, window), prediction)
        assert same_bits(ask(make(Double(data), f"model={model}"), data, window), prediction)


def test_windows_of_a_network_without_a_unit_agree_at_the_anchors_median_depth():
    data = Sphere(num_frames=6, size=(56, 42))
    prior = make(Double(data, unit=lambda call: 0.3 + 1.7 * call), "model=vggt", "anchor_depth_m=2.5")
    assert prior.provenance.settings["scale"] == "arbitrary"
    scale = 2.5 / np.median(data.depth(0, frame_matrix(data), (56, 42)))
    for window in calls(data):
        prediction = ask(prior, data, window)
        true = relative_poses([data.pose(index) for index in window.views])
        np.testing.assert_allclose(prediction.T_anchor_view[:, :3, 3], scale * true[:, :3, 3], atol=1e-5)
        for index, points in zip(window.dense, prediction.points, strict=True):
            depth = data.depth(index, frame_matrix(data), (56, 42))
            np.testing.assert_allclose(points[..., 2], scale * depth, rtol=1e-5)


def test_only_a_conditioned_network_is_told_calibration_and_pose():
    data = Sphere()
    double = Double(data)
    prior = make(double, "model=da3_nested")
    ask(prior, data, calls(data)[0])
    assert all(keys == {"img", "data_norm_type"} for keys in double.seen)
    settings = prior.provenance.settings
    assert (settings["is_calibrated"], settings["anchor_pose"], settings["scale"]) == (False, False, "metric")


def test_an_anchor_without_a_usable_pixel_gives_no_scale_and_so_no_point_and_no_pose():
    def blind_anchor(index, output):
        if index == 0:
            output["non_ambiguous_mask"][:] = False

    data = Sphere()
    prediction = ask(make(Double(data, spoil=blind_anchor), "model=vggt"), data, calls(data)[2])
    assert not prediction.mask.any() and not prediction.points.any()
    assert np.isnan(prediction.T_anchor_view[1:]).all()


def test_what_the_network_calls_ambiguous_is_masked_and_its_points_are_zero():
    def cloudy(index, output):
        output["non_ambiguous_mask"][:, :10] = False
        output["pts3d_cam"][:, :5] = np.nan

    data = Sphere(size=(56, 42))
    prediction = ask(make(Double(data, spoil=cloudy)), data, calls(data)[1])
    assert not prediction.mask[:, :10].any() and prediction.mask[:, 12:].all()
    assert not prediction.points[~prediction.mask].any() and (prediction.confidence[~prediction.mask] == 1).all()
    assert np.isfinite(prediction.points).all() and prediction.confidence.min() >= 1


def test_what_other_views_contradict_is_masked_where_it_is_asked_for():
    def flying(index, output):
        if index == 3:
            output["pts3d_cam"][:, 15:25, 20:30] *= 0.7

    data = Sphere(size=(56, 42))
    window = next(window for window in calls(data) if window.current == 3)
    edges_stay = "masks.max_edge_step=inf"
    plain = ask(make(Double(data, spoil=flying), edges_stay), data, window)
    strict = ask(make(Double(data, spoil=flying), edges_stay, "masks.min_consistent_share=0.5"), data, window)
    assert plain.mask.all()
    assert not strict.mask[1, 15:25, 20:30].any()
    around = np.ones((42, 56), bool)
    around[14:26, 19:31] = False
    assert strict.mask[1][around].mean() > 0.95 and strict.mask[0].mean() > 0.8


def test_a_network_without_confidence_and_ambiguity_counts_as_sure_everywhere():
    def bare(index, output):
        del output["conf"], output["non_ambiguous_mask"]

    data = Sphere()
    prediction = ask(make(Double(data, spoil=bare), "model=vggt"), data, calls(data)[0])
    assert prediction.mask.all() and (prediction.confidence == 1).all()


def test_an_output_that_lacks_geometry_is_refused():
    data = Sphere()
    with pytest.raises(ValueError, match="no pts3d_cam, camera_poses"):
        ask(make(Double(data, spoil=lambda i, o: (o.pop("pts3d_cam"), o.pop("camera_poses")))), data, calls(data)[0])


def test_an_output_of_another_size_is_refused():
    def halved(index, output):
        output["pts3d_cam"] = output["pts3d_cam"][:, ::2, ::2]

    data = Sphere()
    with pytest.raises(ValueError, match=r"images of \(56, 42\) and answered with points of \(28, 21\)"):
        ask(make(Double(data, spoil=halved)), data, calls(data)[0])


def test_images_of_two_sizes_in_one_window_are_refused_with_their_names():
    data, other = Sphere(), Sphere(size=(44, 30))
    window = calls(data)[0]
    frames = [data[0], data[1], other[2]]
    with pytest.raises(ValueError, match=r"frame 0 \(0.png\) has \(40, 30\) and frame 2 \(2.png\) \(44, 30\)"):
        make(Double(data)).predict(window, frames, data.intrinsics)
    with pytest.raises(ValueError, match="in that order"):
        make(Double(data)).predict(window, frames[::-1], data.intrinsics)


def test_a_checkpoint_for_a_network_that_takes_none_is_refused():
    with pytest.raises(hydra.errors.InstantiationException, match="vggt reads its weights from the caches"):
        make(Double(Sphere()), "model=vggt", "checkpoint=somewhere")


@pytest.mark.parametrize(
    ("override", "text"),
    [
        ("model=mapanithing", "one of mapanything, vggt"),
        ("resolution=[518,400]", "multiples of 14"),
        ("resolution=[518]", "multiples of 14"),
        ("anchor_pose=maybe", "on or off"),
        ("anchor_depth_m=0", "above 0"),
        ("compute.amp=int8", "bf16, fp16 or float32"),
    ],
)
def test_a_value_without_sense_is_named(override, text):
    with pytest.raises(hydra.errors.InstantiationException, match=text):
        make(Double(Sphere()), override)


def test_seconds_and_gpu_memory_are_reported_once_there_is_an_inference():
    data = Sphere()
    prior = make(Double(data))
    assert isinstance(prior, Prior) and prior.report() == {}
    for window in calls(data):
        ask(prior, data, window)
    report = prior.report()
    assert report["prior/num_inferences"] == len(calls(data)) and report["prior/peak_gpu_mib"] == 3
    assert 0 < report["prior/seconds_per_inference"] < 10


def test_an_interrupted_recording_is_continued_to_the_same_bytes(tmp_path):
    data = Sphere(num_frames=6)
    make_one = lambda: make(Double(data, unit=lambda call: 2.0**call), "model=vggt")  # noqa: E731
    record(make_one(), data, WINDOW_SIZE, tmp_path / "whole")
    record(make_one(), data, WINDOW_SIZE, tmp_path / "continued")
    (tmp_path / "continued" / "000002.npz").unlink()
    record(make_one(), data, WINDOW_SIZE, tmp_path / "continued")
    for path in (tmp_path / "whole").iterdir():
        assert path.read_bytes() == (tmp_path / "continued" / path.name).read_bytes(), path.name
    replay = Recorded(tmp_path / "whole")
    assert replay.provenance.settings == json.loads(json.dumps(make_one().provenance.settings))
    for window in calls(data):
        assert same_bits(ask(replay, data, window), ask(make_one(), data, window))


def test_the_synthetic_room_comes_back_at_its_frames_pixels():
    """Frames of 64 × 48 on a grid of 56 × 42 and back, into the arrays of the first window that the mapping takes."""
    data = dataset()
    prior = make(Double(DrawnRoom(data, 0, 40)), "anchor_is_metric=true", "anchor_pose=on")
    window = next(windows(len(data), 3))
    prediction = ask(prior, data, window)
    frames = {index: data[index] for index in window.views}
    unit = 1.05 * 1.1  # of the double
    for row, index in enumerate(window.dense):
        mask, error = prediction.mask[row], prediction.points[row][..., 2] / (unit * frames[index].depth) - 1
        assert mask.mean() > 0.5
        assert np.median(np.abs(error[mask])) < 1e-4  # planes come back exactly
        assert (np.abs(error[mask]) < 0.02).mean() > 0.97  # but for pixels beside an edge
    first, _ = to_first_window(prediction, frames, frames[0].T_world_camera, slam_config().observation)
    world = np.asarray(first.T_world_views.as_matrix())
    expected = relative_poses([frames[index].T_world_camera for index in window.views])
    expected[:, :3, 3] *= unit
    np.testing.assert_allclose(world, frames[0].T_world_camera @ expected, atol=1e-5)

"""Runs that have images in common: which these are, the factors between both maps, and each image once at the end."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_kept_points import INTRINSICS, atlas_of, node, posed

from emgs_jax.back_end.factors import Factor, NoiseConfig, chi2, shared_factor
from emgs_jax.back_end.state import BackEnd
from emgs_jax.data.camera_models import from_colmap
from emgs_jax.data.intrinsics import to_lens
from emgs_jax.data.joined import JoinedFrames
from emgs_jax.data.synthetic import Synthetic
from emgs_jax.geometry import Sim3, pose_difference
from emgs_jax.loop_closure.place_recognition import Database, Keyframe, PlaceRecognitionConfig, make_keyframe
from emgs_jax.mapping.merging import shared_placement, without_repeats
from emgs_jax.mapping.records import FrameRecord
from emgs_jax.prior.base import UP_KEYS
from emgs_jax.runs.merging import first_placed, is_same_image, shared_frames, world_of


def keyframe(row: int, image: int, depth: float = 1.0) -> Keyframe:
    """A keyframe of an image: its keypoints and depths follow from that number."""
    rng = np.random.default_rng(image)
    pixels, descriptors = np.float32(rng.uniform(0, 40, (8, 2))), np.uint8(rng.integers(0, 256, (8, 128)))
    depths = np.float32(depth * rng.uniform(1, 3, (4, 5)))
    return Keyframe(row, pixels, descriptors, np.full((8, 3), np.nan, np.float32), INTRINSICS, (64, 48), depths)


def run(images, folder="", first_node=0):
    """A run over some images; every second frame is a keyframe."""
    records = [FrameRecord(row, f"image {image}", float(image), "tracked") for row, image in enumerate(images)]
    offset = {"": 0, "tuesday": 1000}[folder]  # other images of the same names
    known = tuple(keyframe(first_node + row, offset + image) for row, image in enumerate(images) if image % 2 == 0)
    graph = BackEnd(None, INTRINSICS, 0.01, (), database=Database(known), first_node=first_node)
    return SimpleNamespace(records=records, atlas=SimpleNamespace(graph=graph))


@pytest.mark.parametrize(
    ("parts", "other", "pairs"),
    [
        ([run(range(6))], run(range(4, 9)), [(4, 0), (5, 1)]),  # no keyframe of the last is needed
        ([run(range(6), first_node=7)], run(range(4, 9), first_node=3), [(4, 0), (5, 1)]),
        ([run(range(6)), run(range(4, 9))], run(range(8, 12)), [(10, 0)]),
        ([run(range(6)), run(range(4, 9))], run(range(4, 6)), [(4, 0), (5, 1), (6, 0), (7, 1)]),  # all three
        ([run(range(6))], run(range(6, 9)), []),
        ([run(range(6))], run(range(4, 9), "tuesday"), []),
        ([run(range(6))], run(range(5, 6)), []),  # no keyframe says whether it is the same
    ],
)
def test_runs_have_images_in_common_that_have_the_same_name_time_and_keypoints(parts, other, pairs):
    assert shared_frames(parts, other) == pairs


@pytest.mark.parametrize(
    ("focal", "k1", "row", "expected"), [(282, 0.0, 3, True), (260, -0.1, 3, True), (270, -0.05, 20, False)]
)
def test_an_image_is_the_same_where_runs_that_estimate_its_camera_differ(focal, k1, row, expected):
    """Chunks of a video estimate the intrinsics each for itself."""
    dataset = Synthetic(num_frames=40, size=[320, 240])

    def found(row, focal, k1):
        size = (320, 240)
        lens = to_lens(from_colmap("SIMPLE_RADIAL", [focal, 160.0, 120.0, k1], size, "x"), size, "x", {})
        points, is_known = np.full((240, 320, 3), 2.0, np.float32), np.ones((240, 320), bool)
        image = lens.straighten(dataset[row].image)
        return make_keyframe(0, image, points, is_known, lens.intrinsics, PlaceRecognitionConfig())

    assert is_same_image(found(3, 270.0, -0.05), found(row, float(focal), k1)) == expected


def test_the_first_row_of_an_image_that_is_placed_stands_for_all():
    images, placed = [0, 1, 2, 1, 2, 5, 5], [True, False, True, True, True, False, False]
    assert first_placed(images, placed) == [0, 3, 2, 3, 2, 5, 5]


def test_the_factor_of_one_image_says_one_pose_and_the_ratio_of_the_depths():
    factor = shared_factor(keyframe(2, 7), keyframe(5, 7, depth=1.25), 0.02, NoiseConfig())
    assert (factor.a, factor.b, factor.is_loop) == (2, 5, False)
    poses, scales = [posed(row) for row in range(6)], [0.0] * 6
    poses[5], scales[2], scales[5] = poses[2], 0.3, 0.3 - np.log(1.25)  # one world, in which both depths are the same
    assert chi2(factor, poses, scales) < 1e-9
    scales[5] = 0.3
    assert chi2(factor, poses, scales) > 10
    empty = replace(keyframe(5, 7), depths=np.zeros((4, 5), np.float32))
    assert shared_factor(keyframe(2, 7), empty, 0.02, NoiseConfig()) is None


def test_the_images_that_both_maps_have_place_the_other_one_in_its_unit():
    motion = Sim3(1.25, posed(9)[:3, :3], np.array([1.0, -2, 3]))
    rng = np.random.default_rng(0)
    here = [node(seed, 0.1) for seed in range(6)]
    back = motion.inverse()
    there = [replace(one, pose=back.apply_to_poses(one.pose), log_scale=0.1 - np.log(1.25), submap=1) for one in here]
    graph = BackEnd(atlas_of(range(2), 0).graph.config, INTRINSICS, 0.01, (*here, *there))
    factors = [Factor(row, 6 + row, np.eye(4), rng.normal(0, 1e-3), np.eye(7), is_loop=False) for row in range(6)]
    found, loops = shared_placement(graph, 1, factors)
    assert loops == [] and abs(found.scale / 1.25 - 1) < 2e-3
    moved = found.apply_to_poses(np.stack([one.pose for one in there]))
    distance, turn = pose_difference(moved, np.stack([one.pose for one in here]))
    assert distance.max() < 5e-3 and turn.max() < 1e-3


@pytest.mark.parametrize("first", [0, 2])
def test_a_node_that_another_one_stands_for_is_named_nowhere(first):
    """Nodes 3 and 4 are of the images of 1 and 2; the Gaussians that they made stay."""
    atlas = atlas_of(range(10, 16 + first), first)
    ends = [(1, 0), (3, 1), (4, 3), (5, 4), (2, 4)]
    factors = [Factor(first + a, first + b, np.eye(4), 0.0, np.eye(7), is_loop=False) for a, b in ends]
    known = tuple(keyframe(row, row) for row in range(first + 6))
    vectors = np.float32(np.arange(first + 6)[:, None])
    nodes = tuple(replace(one, origin=first + 4) for one in atlas.graph.nodes)
    graph = replace(atlas.graph, nodes=nodes, factors=factors, database=Database(known, vectors=vectors))
    before = atlas.state.map
    found = without_repeats(replace(atlas, graph=graph), [0, 1, 2, 1, 2, 5])
    kept = [*range(first), *(first + row for row in (0, 1, 2, 5))]
    assert [one.frame for one in found.graph.nodes] == [10 + row for row in kept]
    assert {one.origin for one in found.graph.nodes} == {first + 2}
    assert [(one.a - first, one.b - first) for one in found.graph.factors] == [(1, 0), (2, 1), (3, 2)]
    assert [one.frame for one in found.graph.database.keyframes] == [*range(len(kept))]
    assert found.graph.database.vectors.ravel().tolist() == kept
    births = np.asarray(before.birth)[np.asarray(before.gaussians.valid)] - first
    after = np.asarray(found.state.map.birth)[np.asarray(before.gaussians.valid)] - first
    assert after.tolist() == [row if row < 3 else {3: 1, 4: 2, 5: 3}[row] for row in births]
    assert int(found.state.time) == len(kept)
    np.testing.assert_array_equal(found.state.map.gaussians.means, before.gaussians.means)


def test_a_merged_run_has_what_the_first_knows_of_its_unit_and_of_up():
    known = {
        "prior/scale_std_percent": 2.0,
        "prior/up_x": 0.0,
        "prior/up_y": -1.0,
        "prior/up_z": 0.0,
        "prior/up_frame": 1,
    }
    frames = [{"index": 0}, {"index": 1}, {"index": 2}]
    run = SimpleNamespace(frames=frames, metrics=known | {"prior/frames_without_pose": 3, "trajectory/scale": 1.0})
    assert world_of(run, range(6)) == known
    assert world_of(SimpleNamespace(frames=frames, metrics={"trajectory/scale": 1.0}), range(6)) == {}


@pytest.mark.parametrize(
    ("indices", "kept", "number"),
    [
        pytest.param([0, 2, 3], range(6), 1, id="a frame before it was skipped"),
        pytest.param([1, 2, 3], [4, 1, 2, 3, 4, 5], 0, id="the image before it is another run's"),
        pytest.param([1, 2, 3], [0, 4, 2, 3, 4, 5], 3, id="its own image is another run's"),
    ],
)
def test_up_in_a_merged_run_is_known_by_the_number_that_its_frame_has_there(indices, kept, number):
    """Symptom: `emgs export up=z` took the camera of another frame."""
    up = dict(zip(UP_KEYS, (0.0, -1.0, 0.0, 2), strict=True))
    run = SimpleNamespace(frames=[{"index": index} for index in indices], metrics=up)
    assert world_of(run, kept) == up | {UP_KEYS[-1]: number}


def test_joined_images_are_shown_once():
    whole = Synthetic(num_frames=6, size=[64, 48])
    parts = [Synthetic(num_frames=6, stop=4, size=[64, 48]), Synthetic(num_frames=6, start=2, size=[64, 48])]
    joined = JoinedFrames(parts, repeated=[4, 5])
    assert len(joined) == 6
    for row in (3, 4):
        np.testing.assert_array_equal(joined[row].image, whole[row].image)
        assert joined[row].index == row
        np.testing.assert_array_equal(joined.pose(row), whole.pose(row))
    assert joined.fingerprint() != JoinedFrames(parts).fingerprint()

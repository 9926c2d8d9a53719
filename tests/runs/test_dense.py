"""The map as points; oracle: a coloured wall of which every camera sees a part that no other sees."""

from dataclasses import replace
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hand_run import STATUSES, densify_config, hand_run, poses_along, wall
from scene import evaluation_config

from emgs_jax.data.base import Frame
from emgs_jax.io.run_lengths import to_run_lengths
from emgs_jax.ops.camera import unproject
from emgs_jax.runs.dense import center_cloud, dense_map
from emgs_jax.runs.labelling import LabelledMap

pytestmark = pytest.mark.slow


XS = 1.0 + 3.0 * np.arange(len(STATUSES))  # of the cameras, which see one metre to each side
LENGTH = XS[-1] + 2.0


class Pictures:
    """A data set whose images have one colour each, the frame's number."""

    has_ground_truth, classes = False, ()

    def __getitem__(self, index):
        return SimpleNamespace(mask=None, image=np.full((16, 24, 3), index, np.uint8))


@pytest.fixture(scope="module")
def run():
    """The raw prior would look between the cameras, where no frame looks."""
    poses = poses_along(XS)
    return hand_run(poses, poses_along(XS + 1.5), poses, gaussians=wall(0.0, LENGTH))


@pytest.fixture(scope="module")
def labels():
    """Two round Gaussians of two classes: at the wall's two ends."""
    means, round_ = np.array([[0.0, 0.0, 2.0], [LENGTH, 0.0, 2.0]]), np.stack([np.eye(3)] * 2)
    return LabelledMap(means, round_, np.zeros(2), np.array([[0.0, 1.0], [1.0, 0.0]]), ("right", "left"))


@pytest.fixture(scope="module")
def dense(run, labels):
    return dense_map(run, Pictures(), densify_config(), evaluation_config(), labels, num_pictures=3)


def test_every_frame_that_is_not_lost_adds_what_its_own_pose_sees_of_the_map(dense):
    seen = {status: 0 for status in STATUSES}
    for x, status in zip(XS, STATUSES, strict=True):
        count = (np.abs(dense.cloud.points[:, 0] - x) < 1.1).sum()
        assert (count > 200) == (status != "lost"), f"{count} points of a frame that is {status}"
        seen[status] += count
    assert sum(seen.values()) == len(dense.cloud), "nothing is seen from elsewhere"
    assert seen["lost"] == 0


def test_what_moves_gives_its_colour_to_nothing(run, dense):
    """One frame's left half is a mover's: the wall there has no point, since no other frame sees it."""
    is_moving = np.indices((16, 24))[1] < 12
    records = [SimpleNamespace(**vars(record)) for record in run.records]
    records[1].moving_pixels = to_run_lengths(is_moving)
    moving = SimpleNamespace(**vars(run) | {"records": records})
    found = dense_map(moving, Pictures(), densify_config(), evaluation_config(), None, num_pictures=0).cloud
    here = np.abs(dense.cloud.points[:, 0] - XS[1]) < 1.1
    still = np.abs(found.points[:, 0] - XS[1]) < 1.1
    assert (~here).sum() == (~still).sum() and 0.4 * here.sum() < still.sum() < 0.6 * here.sum()
    said = np.full((len(STATUSES), 16, 24), 2.0, np.float32)
    run_of_own = own_run(run, 1.0)
    all_own = own_cloud(run_of_own, own_points(run, said))
    run_of_own.records[1] = replace(run_of_own.records[1], moving_pixels=to_run_lengths(is_moving))
    own = own_cloud(run_of_own, own_points(run, said))
    counts = [[(np.abs(cloud.points[:, 0] - x) < 1.1).sum() for x in XS] for cloud in (all_own, own)]
    assert 0.4 * counts[0][1] < counts[1][1] < 0.6 * counts[0][1] and counts[0][2:] == counts[1][2:]


def test_the_points_are_the_walls_with_its_normals_and_the_images_colours(dense):
    """An image has the number of its frame as its colour, and no point is seen by two of them."""
    points, normals, colors = dense.cloud.points, dense.cloud.normals, dense.cloud.colors
    np.testing.assert_allclose(points[:, 2], 2.0, atol=2e-3)  # a pixel's mean depth, of float32 at 2 m
    np.testing.assert_allclose(normals, np.broadcast_to([0.0, 0.0, -1.0], normals.shape), atol=1e-5)
    number = np.abs(points[:, :1] - XS).argmin(axis=1)
    np.testing.assert_allclose(255.0 * colors, np.broadcast_to(number[:, None], colors.shape), atol=1e-9)


def test_pictures_are_of_frames_spread_evenly_over_those_that_are_not_lost(dense):
    assert [picture["title"] for picture in dense.pictures] == ["frame 0", "frame 2", "frame 5"]
    for picture, row in zip(dense.pictures, (0, 2, 5), strict=True):
        assert (picture["image"] == row).all()
        middle = picture["rendered_color"][8, 12, 0]
        np.testing.assert_allclose(20.0 * middle, XS[row], atol=0.2)
        np.testing.assert_allclose(picture["rendered_depth"][picture["valid"]], 2.0, atol=2e-3)


class Truth:
    """What the frames of the wall would be if it were twice as large and gray."""

    has_ground_truth, classes = True, ("left", "right")

    def __len__(self):
        return len(STATUSES)

    def __getitem__(self, index):
        image = np.full((16, 24, 3), 51 * index, np.uint8)
        labels = np.full((16, 24), int(XS[index] > LENGTH / 2), np.int32)
        return Frame(index, 0.0, "f", image, np.full((16, 24), 4.0, np.float32), labels=labels)


def compared(run):
    larger = np.stack(run.poses)
    larger[:, :3, 3] *= 2.0
    return hand_run(run.poses, run.raw_poses, larger, gaussians=run.state.map.gaussians)


def test_the_views_are_compared_with_their_frames_at_the_size_of_the_alignment_and_lost_ones_are_empty(run, dense):
    """Coverage is that of the points: the wall fills every view, a sixth of which is lost."""
    found = dense_map(compared(run), Truth(), densify_config(), evaluation_config(), num_pictures=0)
    np.testing.assert_array_equal(found.cloud.points, dense.cloud.points)
    metrics = found.rendering
    assert metrics["rendering/num_frames"] == len(STATUSES) and metrics["rendering/worst_coverage_percent"] == 0.0
    np.testing.assert_allclose(metrics["rendering/coverage_percent"], 100.0 * 5 / 6, atol=0.5)
    np.testing.assert_allclose(metrics["rendering/depth_within_5_percent"], metrics["rendering/coverage_percent"])
    assert metrics["rendering/depth_l1_m"] < 2 * 2e-3  # as of the points
    gray = np.arange(len(STATUSES)) / 5
    is_seen = np.array(STATUSES) != "lost"
    errors = (np.stack([XS / 20, np.full_like(XS, 0.25), np.full_like(XS, 0.5)]) - gray)[:, is_seen] ** 2
    np.testing.assert_allclose(metrics["rendering/psnr_db"], -10 * np.log10(np.mean(errors)), atol=0.05)
    assert dense.rendering == {}, "nobody knows the truth"
    assert metrics["rendering/label_accuracy_percent"] is None, "the map has no classes"


def test_the_classes_of_rendered_pixels_are_compared_with_those_of_the_frames_by_name(run, labels):
    metrics = dense_map(compared(run), Truth(), densify_config(), evaluation_config(), labels, num_pictures=0).rendering
    np.testing.assert_allclose(metrics["rendering/label_accuracy_percent"], 100.0 * 5 / 6, atol=0.5)  # one is lost


def own_points(run, said, shift=0.0):
    """Camera-frame points of every frame at depths (n, h, w), `shift` pixels right of its rays."""
    points = np.array(unproject(run.camera, jnp.ones((16, 24))))
    points[..., 0] += shift / 24.0
    return np.float32(said[..., None] * points)


def own_run(run, scale):
    found = hand_run(run.poses, run.raw_poses, run.true_poses, gaussians=run.state.map.gaussians)
    found.records = [replace(record, scale=scale) for record in found.records]
    return found


def own_cloud(run, own):
    return dense_map(run, Pictures(), densify_config("densify.points=own"), evaluation_config(), own=own).cloud


def test_a_point_lies_where_its_frame_puts_it_unless_the_map_shows_another_surface_there(run):
    """The wall is at 2: left of the camera the frames say 2.05, right of it 3, and in the upper row nothing."""
    said = np.full((len(STATUSES), 16, 24), 1.025, np.float32)
    said[:, :, 12:], said[:, 0] = 1.5, 0.0
    found = own_cloud(own_run(run, 2.0), own_points(run, said))
    np.testing.assert_allclose(found.points[:, 2], 2.05, atol=1e-5)  # float32
    np.testing.assert_allclose(found.normals, np.broadcast_to([0.0, 0.0, -1.0], found.normals.shape), atol=1e-5)
    offsets = found.points[:, None, 0] - XS[[status != "lost" for status in STATUSES]]
    left = np.array([offset for offset in (np.arange(12) - 11.5) * 2.05 / 24])
    assert (np.abs(offsets[..., None] - left).min((1, 2)) < 0.01).all() and len(found) > 5 * 12 * 15 / 2
    assert found.points[:, 1].min() > (0.4 - 7.5) * 2.05 / 24, "the upper row has no depth"


def test_the_map_is_asked_where_a_point_appears_which_need_not_be_the_pixel_that_it_is_of(run):
    """The wall ends at x = 1 of frame 0: its right half shows nothing. Points are four pixels right of their rays."""
    half = own_run(run, 1.0)
    map = half.state.map
    half.state.map = eqx.tree_at(lambda m: m.gaussians.valid, map, map.gaussians.means[:, 0] < XS[0])
    own = own_points(run, np.full((len(STATUSES), 16, 24), 3.0, np.float32), shift=4.0)
    own[1:] = 0.0
    found = own_cloud(half, own)
    drawn = dense_map(half, Pictures(), densify_config(), evaluation_config()).cloud
    edge = 24 * (drawn.points[:, 0].max() - XS[0]) / 2.0  # pixels right of the camera's axis that the map covers
    np.testing.assert_allclose(24 * (found.points[:, 0].min() - XS[0]) / 3.0, edge + 1.0, atol=0.6)
    np.testing.assert_allclose(found.points[:, 2], 3.0, atol=1e-5)
    fitted = found.normals.any(axis=1)  # the borders of an image have too few neighbours
    np.testing.assert_allclose(found.normals[fitted], np.tile([0.0, 0.0, -1.0], (fitted.sum(), 1)), atol=1e-3)
    assert fitted.sum() > 50


def test_points_of_frames_change_nothing_unless_points_are_to_lie_there_and_are_asked_for_then(run, dense, labels):
    poison = np.full((len(STATUSES), 16, 24, 3), np.nan, np.float32)
    config = densify_config()
    found = dense_map(run, Pictures(), config, evaluation_config(), labels, num_pictures=3, own=poison)
    np.testing.assert_array_equal(found.cloud.points, dense.cloud.points)
    with pytest.raises(ValueError, match="own="):
        dense_map(run, Pictures(), densify_config("densify.points=own"), evaluation_config())


def test_points_and_pictures_have_the_class_of_the_gaussians_there(dense, labels):
    assert dense.labels.classes == labels.classes and dense.labels.points is dense.cloud.points
    np.testing.assert_array_equal(dense.labels.labels, dense.cloud.points[:, 0] < LENGTH / 2)
    for picture, label in zip(dense.pictures, (1, 1, 0), strict=True):
        np.testing.assert_array_equal(picture["labels"], np.where(picture["valid"], label, -1))


def test_a_pixel_that_is_covered_too_little_for_a_depth_has_a_class(run, labels):
    config = eqx.tree_at(lambda c: c.min_alpha, densify_config(), jnp.asarray(0.9999))
    (picture, *_) = dense_map(run, Pictures(), config, evaluation_config(), labels, num_pictures=3).pictures
    rim = ~picture["valid"]
    assert rim.any() and (picture["labels"][rim] == 1).mean() > 0.5 and (picture["rendered_depth"][rim] == 0).all()


def test_without_labels_and_without_a_frame_that_is_known_there_is_nothing_to_show(run):
    lost = hand_run(run.poses, run.raw_poses, run.true_poses, ["lost"] * len(STATUSES), run.state.map.gaussians)
    nothing = dense_map(lost, Pictures(), densify_config(), evaluation_config())
    assert len(nothing.cloud) == 0 and nothing.pictures == [] and nothing.labels is None


def test_centres_are_the_means_of_the_rows_in_use(run):
    cloud = center_cloud(run)
    assert len(cloud) == 20 * round(10 * LENGTH)
    np.testing.assert_allclose(cloud.points[:, 2], 2.0)
    np.testing.assert_allclose(20.0 * cloud.colors[:, 0], cloud.points[:, 0], atol=1e-5)
    np.testing.assert_array_equal(cloud.normals, np.broadcast_to([0.0, 0.0, -1.0], cloud.points.shape))
    assert cloud.points.dtype == np.float64

"""Oracles: rotations that are known by hand, the pixels of the picture, the same bytes twice."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial.transform import Rotation

from emgs_jax.drawing.colors import PATHS, class_colors, rgb
from emgs_jax.drawing.overview import (
    Paths,
    _draw_frames,
    _draw_map,
    below_ceiling,
    draw_overview,
    fill_holes,
    paint_from_above,
    view_from_above,
)
from emgs_jax.evaluation.clouds import PointCloud

pytestmark = pytest.mark.slow


OURS, TRUTH, *MOVED = (255 * rgb(PATHS[name].paper) for name in ("poses", "truth", "online", "loops"))


def path_along(direction, n=5):
    """Level cameras (OpenCV axes in a z-up world) that look along x and move along `direction`."""
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    poses[:, :3, 3] = np.outer(np.linspace(0, 1, n), direction)
    return poses


def test_from_above_up_is_up_and_the_path_runs_to_the_right_and_the_view_turns_with_the_world():
    rotation = view_from_above(path_along([0.0, -3.0, 0.2]))
    np.testing.assert_allclose(rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    turn = Rotation.from_rotvec([0.3, -1.2, 0.5]).as_matrix()
    poses = path_along([0.5, -3.0, 0.2])
    turned = poses.copy()
    turned[:, :3, :3], turned[:, :3, 3] = turn @ poses[:, :3, :3], poses[:, :3, 3] @ turn.T
    np.testing.assert_allclose(view_from_above(turned) @ turn, view_from_above(poses), atol=1e-9)


def test_floors_and_walls_make_the_picture_upright():
    """Cameras that lean to one side; normals of any length, as the page keeps them."""
    poses, lean = path_along([0.5, -3.0, 0.2]), Rotation.from_euler("x", 12, degrees=True).as_matrix()
    poses[:, :3, :3] = lean @ poses[:, :3, :3]
    normals = np.concatenate([np.tile([0, 0, 127], (50, 1)), np.tile([0, -127, 0], (50, 1)), np.zeros((9, 3))])
    assert np.degrees(np.arccos(view_from_above(poses)[2, 2])) == pytest.approx(12, abs=0.1)
    np.testing.assert_allclose(view_from_above(poses, normals.astype(np.int8))[2], [0, 0, 1], atol=0.01)


@pytest.mark.parametrize("poses", [path_along([0.0, 0.0, 0.0]), path_along([0, 0, 0], 1), path_along([0, 0, 5.0])])
def test_cameras_that_do_not_move_sideways_still_give_a_rotation(poses):
    rotation = view_from_above(poses)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
    np.testing.assert_allclose(rotation[2], [0, 0, 1], atol=1e-9)


def test_the_highest_point_of_a_cell_is_seen_and_the_ceiling_is_not():
    points = np.array([[0.05, 0.05, 0.0], [0.06, 0.04, 1.0], [0.35, 0.15, 0.2], [0.05, 0.05, 2.5]])
    colors = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [1.0, 1.0, 1.0]])
    seen = below_ceiling(points[:, 2], np.array([1.4, 1.5]))
    np.testing.assert_array_equal(seen, [True, True, True, False])
    image, extent = paint_from_above(points[seen], colors[seen], 0.1)
    np.testing.assert_allclose(extent, (0.0, 0.4, 0.0, 0.2))
    assert image.shape == (2, 4, 4)
    np.testing.assert_array_equal(image[0, 0], [0, 1, 0, 1])
    np.testing.assert_array_equal(image[1, 3], [0, 0, 1, 1])
    assert image[..., 3].sum() == 2
    assert below_ceiling(np.full(10, 9.0), np.zeros(2)).all()


def test_holes_take_the_colour_around_them_and_painted_cells_keep_theirs():
    image = np.zeros((7, 7, 4))
    image[1:6, 1:6] = [0.2, 0.4, 0.6, 1.0]
    image[3, 3] = 0.0
    filled = fill_holes(image)
    np.testing.assert_allclose(filled[3, 3], [0.2, 0.4, 0.6, 1.0])
    np.testing.assert_array_equal(filled[image[..., 3] > 0], image[image[..., 3] > 0])
    np.testing.assert_array_equal(filled[0], 0.0)


def shares_of(path, *colors) -> list[np.ndarray]:
    """Where a picture has each of the colours, (h, w) bools."""
    image = np.asarray(Image.open(path).convert("RGB")).astype(int)
    return [np.all(np.abs(image - color) <= 8, axis=-1) for color in colors]


def a_cloud(points=None, color=(0.0, 0.0, 1.0)) -> PointCloud:
    points = np.zeros((0, 3)) if points is None else points
    return PointCloud(points, np.zeros_like(points), np.tile(color, (len(points), 1)))


@pytest.mark.parametrize(("num_frames", "num_points", "has_truth"), [(2, 3000, True), (0, 0, False)])
def test_the_picture_shows_floor_and_paths_and_labels_with_a_legend_and_is_the_same_twice(
    tmp_path, num_frames, num_points, has_truth
):
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-2, 2, (num_points, 2)), np.full((num_points, 1), -1.0)], 1)
    points[: num_points // 100] = np.nan
    poses = path_along([1.0, -0.5, 0.0])
    depth, labels = np.full((24, 32), np.nan), np.full((24, 32), 2)
    depth[4:, :], labels[:, 16:] = 2.0, -1
    frame = {"image": np.zeros((24, 32, 3), np.uint8), "rendered_color": np.full((24, 32, 3), np.nan)}
    frame |= {"rendered_depth": depth, "valid": np.ones((24, 32), bool), "title": "frame 0", "labels": labels}
    paths = Paths(poses, np.ones(len(poses), bool), poses if has_truth else None)
    for name in ("a.png", "b.png") if num_frames else ("a.png",):
        classes = ("wall", "floor", "chair $_$") if num_frames else ()
        draw_overview(tmp_path / name, a_cloud(points), paths, [frame] * num_frames, "a run of $\\a$", classes)
    path = tmp_path / "a.png"
    assert not num_frames or path.read_bytes() == (tmp_path / "b.png").read_bytes()
    floor, ours, truth = shares_of(path, (0, 0, 255), OURS, TRUTH)
    assert min(floor.shape) > 500 and (floor.mean() > 0.1) == (num_points > 0)
    assert ours.mean() > 1e-4 and (truth.mean() > 1e-4) == has_truth
    of_classes = shares_of(path, *(255 * color for color in class_colors(3)))
    assert [bool(share.sum() > 50) for share in of_classes] == [False, False, num_frames > 0]
    rows = np.nonzero(of_classes[2].any(1))[0]
    assert not num_frames or rows.max() > 0.9 * len(floor), "the legend is below the frames"


def test_what_is_lost_or_unknown_is_a_gap_and_loops_are_lines_beside_the_path_before(tmp_path):
    truth, estimate, online = (path_along([0.0, 4.0, 0.0], 9) for _ in range(3))
    truth[0, 0, 3] = 1.2  # the highest, beside the legend
    estimate[:, 0, 3], online[:, 0, 3] = 0.8, 0.4
    holed = truth.copy()
    holed[6] = np.nan

    def columns_of(paths: Paths, *colors) -> list[np.ndarray]:
        """Columns of the picture, the path's direction, in which each colour is seen left of the legend."""
        draw_overview(tmp_path / "a.png", a_cloud(), paths, [], "a run")
        return [np.flatnonzero(share[len(share) // 4 :].any(0)) for share in shares_of(tmp_path / "a.png", *colors)]

    whole = columns_of(Paths(estimate, np.ones(9, bool), truth), OURS, TRUTH, *MOVED)
    broken = columns_of(Paths(estimate, np.arange(9) != 3, holed), OURS, TRUTH)
    moved = columns_of(Paths(estimate, np.ones(9, bool), truth, online, ((0, 8),)), *MOVED)
    gaps = [[np.diff(columns).max() / np.ptp(columns) for columns in found[:2]] for found in (whole, broken)]
    assert max(gaps[0]) < 0.1 and 0.2 < min(gaps[1]) <= max(gaps[1]) < 0.3  # two of eight pieces
    assert min(map(len, moved)) > 200 and not any(map(len, whole[2:]))


def test_lengths_are_metres_only_where_that_is_known():
    for unit, shown in (("m", "metres"), ("units", "units")):
        axes = Figure().subplots()
        poses = path_along([1.0, -0.5, 0.0])
        _draw_map(axes, a_cloud(), Paths(poses, np.ones(5, bool), unit=unit))
        assert axes.get_xlabel() == shown and [text.get_text().split()[1] for text in axes.texts] == [unit]
        grid, depth = Figure().subplots(1, 3, squeeze=False), np.ones((4, 5))
        frame = {"image": np.zeros((4, 5, 3)), "rendered_color": np.zeros((4, 5, 3)), "title": "frame 0"}
        _draw_frames(grid, [frame | {"rendered_depth": depth, "valid": depth > 0}], unit)
        assert grid[0, 0].figure.axes[-1].get_ylabel() == f"depth [{unit}]"
        assert not any(spine.get_visible() for spine in axes.spines.values())
        ends = [(line.get_marker(), *line.get_xydata().T) for line in axes.lines if line.get_marker() in ("o", "s")]
        path = poses[:, :3, 3] @ view_from_above(poses).T
        assert ends == [("o", *path[0, :2]), ("s", *path[-1, :2])], "a disc where it begins, a square where it ends"


def test_features_are_drawn_from_above_below_the_map(tmp_path):
    x, z = (values.ravel() for values in np.meshgrid(np.linspace(-2, 2, 100), np.linspace(-2, 2, 100)))
    points = np.stack([x, np.zeros_like(x), z], axis=1)
    grey, teal = (a_cloud(points, color) for color in ((0.5, 0.5, 0.5), (0.0, 0.6, 0.4)))
    paths = Paths(path_along([1.0, -0.5, 0.0]), np.ones(5, bool))
    draw_overview(tmp_path / "a.png", grey, paths, [], "a run", (), teal)
    (found,) = shares_of(tmp_path / "a.png", (0, 153, 102))
    assert found.sum() > 1000 and not found[: len(found) // 2].any()


def test_colours_of_many_classes_differ():
    colors = class_colors(40)
    distance = np.linalg.norm(colors[:, None] - colors[None], axis=-1)
    assert distance[~np.eye(40, dtype=bool)].min() > 0.02 and colors.min() >= 0.0 and colors.max() <= 1.0

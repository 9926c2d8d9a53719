"""A map that follows its frames: exact where nothing moves, a rigid motion, there and back, and pixels that stay."""

import equinox as eqx
import jax
import jaxlie
import numpy as np
import pytest
import scene as sc

from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.io.map_file import load_map, save_map
from emgs_jax.pose_graph.deform import DeformConfig, deform, deform_view
from emgs_jax.pose_graph.factors import Nodes

moved_map, moved_view = sc.on_host(deform), sc.on_host(deform_view)
COUNT, FLOOR = 24, sc.device(0.001)  # Gaussians of every map
NUM_NODES = 60  # of every graph, the last ones often of no Gaussian: one program for all
ALONE, TOGETHER = DeformConfig(1, 0), DeformConfig(9, 40)  # by the own birth, and by those of neighbours


@pytest.fixture(scope="module")
def map() -> GaussianMap:
    """A third of the Gaussians of each of three frames."""
    return sc.fresh_map(sc.random_gaussians(COUNT, 1, 2), birth=np.arange(COUNT) % 3)


def nodes(poses, log_scales=None) -> Nodes:
    """So many nodes, and the last one again and again, far from every frame that made something."""
    rows = np.minimum(np.arange(NUM_NODES), len(poses) - 1)
    scales = np.zeros(len(poses)) if log_scales is None else np.asarray(log_scales)
    T = np.stack([T.wxyz_xyz for T in poses])[rows]
    return Nodes(jaxlie.SE3(sc.device(T)), sc.device(scales[rows]), sc.device(np.ones(NUM_NODES, bool)))


def node(known: Nodes, row: int) -> jaxlie.SE3:
    return jaxlie.SE3(np.asarray(known.T_world.wxyz_xyz)[row])


@pytest.fixture(scope="module")
def before() -> Nodes:
    return nodes([sc.path_pose(i) for i in range(3)])


@pytest.mark.parametrize("config", [ALONE, TOGETHER])
def test_where_no_node_moves_the_map_is_the_same_bit_for_bit(map, before, config):
    sc.assert_same(moved_map(map, before, before, FLOOR, config), map)


def test_only_what_was_born_with_a_node_moves_with_it(map, before):
    after = nodes([sc.path_pose(0), sc.path_pose(1), sc.path_pose(7)])
    new = moved_map(map, before, after, FLOOR, ALONE)
    stays = np.asarray(map.birth) != 2
    sc.assert_same(sc.rows_of(new, stays), sc.rows_of(map, stays))
    assert (np.abs(new.gaussians.means - map.gaussians.means).max(axis=1)[~stays] > 1e-3).all()


@pytest.mark.parametrize("config", [ALONE, TOGETHER])
def test_one_motion_of_all_nodes_is_that_motion_of_the_map(map, before, config):
    motion = sc.pose(rotation=(0.3, -0.2, 0.5), translation=(1.0, -2.0, 0.5))
    after = nodes([sc.product(motion, sc.path_pose(i)) for i in range(3)])
    new, expected = moved_map(map, before, after, FLOOR, config).gaussians, sc.move_gaussians(motion, map.gaussians)
    sc.assert_rows_near(new, expected, atol=5e-6)  # coordinates of 3 m


def test_a_map_that_moved_is_one_that_can_be_loaded(map, before, tmp_path):
    """Covariances that were not quite symmetric were refused: no map with a closed loop could be shown or asked."""
    after = nodes([sc.path_pose(i + 4) for i in range(3)], (0.1, -0.2, 0.05))
    new = moved_map(map, before, after, FLOOR, TOGETHER)
    sc.assert_same(new.gaussians.covs, new.gaussians.covs.swapaxes(1, 2))
    save_map(tmp_path / "map.npz", jax.tree.map(sc.device, new))
    sc.assert_same(load_map(tmp_path / "map.npz"), new)


def test_what_a_camera_saw_at_a_pixel_stays_there_and_is_larger_by_the_scale(map, before):
    """A scale that acts before the new pose; about the world's origin it would move every pixel."""
    after = nodes([sc.path_pose(i + 4) for i in range(3)], (0.1, -0.2, 0.05))
    new = moved_map(map, before, after, FLOOR, ALONE)
    for row, birth in enumerate(np.asarray(map.birth)):
        seen = []
        for one, known in ((map, before), (new, after)):
            T = np.linalg.inv(sc.matrix_of(node(known, birth)))
            mean, cov = (np.asarray(x, float)[row] for x in (one.gaussians.means, one.gaussians.covs))
            seen.append((T[:3, :3] @ mean + T[:3, 3], cov))
        (old, old_cov), (now, now_cov) = seen
        scale = np.exp(float(np.asarray(after.log_scale)[birth]))
        np.testing.assert_allclose(now, scale * old, rtol=1e-4, atol=1e-5)  # so it is at the same pixel
        spread, larger = (np.linalg.eigvalsh(cov) - float(FLOOR) ** 2 for cov in (old_cov, now_cov))
        np.testing.assert_allclose(larger, scale**2 * spread, rtol=1e-3, atol=1e-6)


def test_a_view_moves_with_its_node(before):
    view = sc.random_observation(50)
    after = nodes([sc.path_pose(i + 4) for i in range(3)], (0.0, 0.0, 0.1))
    new = moved_view(view, before, after, np.int32(2))
    local = sc.moved_points(sc.pose_of(np.linalg.inv(sc.matrix_of(node(before, 2)))), view)
    expected = sc.moved_points(node(after, 2), local, np.exp(0.1))
    np.testing.assert_allclose(new.points, expected.points, atol=1e-5)
    sc.assert_same(moved_view(view, before, before, np.int32(2)), view)


def strip(births) -> GaussianMap:
    """Gaussians 5 cm apart along x, 2 m in front of cameras that go along it, each born as `births` says; free rows."""
    rows, births = np.arange(COUNT), np.asarray(births)
    means = np.stack([0.05 * rows, np.zeros(COUNT), np.full(COUNT, 2.0)], -1)
    one = sc.replace(sc.random_gaussians(COUNT, 1, 2), means=means, valid=rows < len(births))
    return sc.fresh_map(one, birth=births[np.minimum(rows, len(births) - 1)])


def line(shifts, turns=None, log_scales=None) -> Nodes:
    """Cameras a decimetre apart along x, shifted across (m) and turned about the line of sight (rad)."""
    turns = np.zeros(len(shifts)) if turns is None else turns
    poses = [sc.pose(rotation=(0, 0, turns[i]), translation=(0.1 * i, shifts[i], 0.0)) for i in range(len(shifts))]
    return nodes(poses, log_scales)


def moved_strip(births, *arguments):
    """The Gaussians that are there."""
    return sc.rows_of(moved_map(strip(births), *arguments).gaussians, slice(len(births)))


def test_a_surface_that_several_frames_made_is_not_torn_where_their_parts_meet():
    """Twenty cameras bend sideways by 20 cm at the end; every fifth made a quarter of a metre of a strip."""
    births = np.repeat([0, 5, 10, 15], 5)
    before, after = line(np.zeros(20)), line(0.2 * (np.arange(20) / 19) ** 2)
    steps = {
        name: np.abs(np.diff(moved_strip(births, before, after, FLOOR, config).means[:, 1]))
        for name, config in {"alone": ALONE, "together": TOGETHER}.items()
    }
    assert steps["alone"].max() > 0.06  # between the third part and the fourth: their cameras' 12.5 - 5.5 cm
    assert steps["together"].max() < 0.025
    assert steps["together"].sum() > 0.6 * steps["alone"].sum()  # it still bends


def test_two_visits_of_a_place_move_apart_each_as_its_own_cameras():
    births = np.array([3, 55] * 6)
    before = line(np.zeros(60))
    after = line(np.where(np.arange(60) > 30, 0.3, 0.0))
    new = moved_strip(births, before, after, FLOOR, TOGETHER).means[:, 1]
    np.testing.assert_allclose(new, np.where(births == 55, 0.3, 0.0), atol=1e-6)


def test_turns_and_scales_are_means_of_those_of_the_neighbours():
    """Half of the cameras turn by .2 rad and grow by e^.1: with all as neighbours a third of six does."""
    births = np.array([0, 0, 1, 0, 0, 1])
    before, after = line(np.zeros(2)), line(np.zeros(2), turns=[0.0, 0.2], log_scales=[0.0, 0.1])
    given = sc.rows_of(strip(births).gaussians, slice(6))
    new = moved_strip(births, before, after, FLOOR, DeformConfig(6, 40))
    turn = sc.matrix_of(sc.pose((0, 0, 0.2 / 3)))[:3, :3]
    np.testing.assert_allclose(new.normals, given.normals @ turn.T, atol=1e-4)
    floor = float(FLOOR) ** 2 * np.eye(3)
    expected = np.exp(0.2 / 3) * turn @ (given.covs - floor) @ turn.T + floor
    np.testing.assert_allclose(new.covs, expected, rtol=2e-3, atol=1e-6)


def test_a_free_row_is_no_neighbour_and_stays(map, before):
    after, used = nodes([sc.path_pose(i + 4) for i in range(3)]), np.arange(COUNT) % 4 > 0
    some = sc.replace(map.gaussians, valid=used)
    far = sc.replace(some, means=np.asarray(some.means) + 0.01 * ~used[:, None])
    maps = (eqx.tree_at(lambda m: m.gaussians, map, one) for one in (some, far))
    new, other = (moved_map(one, before, after, FLOOR, TOGETHER).gaussians.means for one in maps)
    np.testing.assert_array_equal(new[used], other[used])
    np.testing.assert_array_equal(new[~used], np.asarray(some.means)[~used])


def test_where_few_are_left_nothing_stands_in_for_the_missing_neighbours(before):
    """Row 0 is what a search without an answer gives."""
    map = strip([1] + [0] * 11)
    map = eqx.tree_at(lambda m: m.gaussians.valid, map, sc.device((np.arange(COUNT) >= 9) & (np.arange(COUNT) < 12)))
    after = nodes([sc.path_pose(0), sc.path_pose(7), sc.path_pose(2)])
    sc.assert_same(moved_map(map, before, after, FLOOR, TOGETHER), map)  # those left were born with a node that stays


def test_a_rotation_is_the_same_with_either_sign_of_its_quaternion(map, before):
    after = nodes([sc.path_pose(i + 4) for i in range(3)])
    signs = np.where(np.arange(NUM_NODES)[:, None] == 1, [-1.0] * 4 + [1.0] * 3, 1.0)
    other = Nodes(jaxlie.SE3(sc.device(after.T_world.wxyz_xyz * signs)), after.log_scale, after.valid)
    one, two = (moved_map(map, before, known, FLOOR, TOGETHER).gaussians for known in (after, other))
    sc.assert_rows_near(one, two, atol=1e-5)


def test_a_node_that_is_not_in_use_may_hold_anything(map, before):
    """A motion that is not finite, of a neighbour's birth that does not count, was NaN for the Gaussian beside it."""
    after, is_used = nodes([sc.path_pose(i + 4) for i in range(3)]), np.arange(NUM_NODES) < 2

    def holding(known, value):
        poses = np.where(is_used[:, None], known.T_world.wxyz_xyz, np.float32(value))
        scales = np.where(is_used, known.log_scale, np.float32(value))
        return Nodes(jaxlie.SE3(sc.device(poses)), sc.device(scales), sc.device(is_used))

    known = moved_map(map, holding(before, 0.5), holding(after, 0.5), FLOOR, TOGETHER)
    own = np.asarray(map.birth) < 2
    assert (known.gaussians.means != map.gaussians.means)[own].any()
    for value in (np.nan, 1e30):
        sc.assert_same(moved_map(map, holding(before, value), holding(after, value), FLOOR, TOGETHER), known)

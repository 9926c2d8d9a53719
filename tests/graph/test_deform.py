"""A map that follows its frames: exact where nothing moves, a rigid motion, there and back, and pixels that stay."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scene import assert_same, move_gaussians, path_pose, pose, random_gaussians, random_observation, stack_poses

from emgs_jax.gaussian_map import GaussianMap, new_map
from emgs_jax.graph.deform import deform, deform_view
from emgs_jax.graph.measurements import Nodes
from emgs_jax.ops.camera import Camera, project

moved_map, moved_view = eqx.filter_jit(deform), eqx.filter_jit(deform_view)
COUNT, FLOOR = 24, jnp.asarray(0.001)


@pytest.fixture(scope="module")
def map() -> GaussianMap:
    """A third of the Gaussians of each of three frames."""
    one = new_map(random_gaussians(COUNT, 1, 2), jnp.ones(COUNT), jnp.ones(()), jnp.asarray(0))
    return eqx.tree_at(lambda m: m.birth, one, jnp.arange(COUNT, dtype=jnp.int32) % 3)


def nodes(poses, log_scales=(0.0, 0.0, 0.0)) -> Nodes:
    return Nodes(stack_poses(poses), jnp.asarray(log_scales, jnp.float32), jnp.ones(3, bool))


@pytest.fixture(scope="module")
def before() -> Nodes:
    return nodes([path_pose(i) for i in range(3)])


def test_where_no_node_moves_the_map_is_the_same_bit_for_bit(map, before):
    assert_same(moved_map(map, before, before, FLOOR), map)


def test_only_what_was_born_with_a_node_moves_with_it(map, before):
    after = nodes([path_pose(0), path_pose(1), path_pose(7)])
    new = moved_map(map, before, after, FLOOR)
    stays = np.asarray(map.birth) != 2
    assert_same(jax.tree.map(lambda x: x[stays], new), jax.tree.map(lambda x: x[stays], map))
    assert (np.abs(np.asarray(new.gaussians.means - map.gaussians.means)).max(axis=1)[~stays] > 1e-3).all()


def test_one_motion_of_all_nodes_is_that_motion_of_the_map(map, before):
    motion = pose(rotation=(0.3, -0.2, 0.5), translation=(1.0, -2.0, 0.5))
    after = nodes([motion @ path_pose(i) for i in range(3)])
    new, expected = moved_map(map, before, after, FLOOR).gaussians, move_gaussians(motion, map.gaussians)
    for name in ("means", "covs", "normals"):
        np.testing.assert_allclose(getattr(new, name), getattr(expected, name), atol=5e-6)  # coordinates of 3 m


def test_there_and_back_is_where_it_was(map, before):
    after = nodes([path_pose(i + 4) for i in range(3)], (0.1, -0.2, 0.05))
    back = moved_map(moved_map(map, before, after, FLOOR), after, before, FLOOR)
    for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(map), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_what_a_camera_saw_at_a_pixel_stays_there_and_is_larger_by_the_scale(map, before):
    """A scale that acts before the new pose; about the world's origin it would move every pixel."""
    camera = Camera([300.0, 310.0], [160.0, 120.0], 320, 240)
    after = nodes([path_pose(i + 4) for i in range(3)], (0.1, -0.2, 0.05))
    new = moved_map(map, before, after, FLOOR)
    for row in range(COUNT):
        birth = int(map.birth[row])
        seen = []
        for one, known in ((map, before), (new, after)):
            T = jaxlie.SE3(known.T_world.wxyz_xyz[birth]).inverse()
            seen.append((T @ one.gaussians.means[row], one.gaussians.covs[row]))
        (old, old_cov), (now, now_cov) = seen
        scale = float(jnp.exp(after.log_scale[birth]))
        np.testing.assert_allclose(now, scale * old, rtol=1e-4, atol=1e-5)
        if old[2] > 0.1:
            np.testing.assert_allclose(project(camera, now)[0], project(camera, old)[0], atol=0.05)
        spread, larger = (np.linalg.eigvalsh(np.asarray(cov)) - float(FLOOR) ** 2 for cov in (old_cov, now_cov))
        np.testing.assert_allclose(larger, scale**2 * spread, rtol=1e-3, atol=1e-6)


def test_a_view_moves_with_its_node(before):
    view = random_observation(50)
    after = nodes([path_pose(i + 4) for i in range(3)], (0.0, 0.0, 0.1))
    new = moved_view(view, before, after, jnp.asarray(2))
    old, now = (jaxlie.SE3(known.T_world.wxyz_xyz[2]) for known in (before, after))
    expected = np.exp(0.1) * np.asarray(jax.vmap(old.inverse().apply)(view.points))
    expected = np.asarray(jax.vmap(now.apply)(jnp.asarray(expected, jnp.float32)))
    np.testing.assert_allclose(new.points[view.valid], expected[np.asarray(view.valid)], atol=1e-5)
    assert_same(moved_view(view, before, before, jnp.asarray(2)), view)

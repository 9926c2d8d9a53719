"""Gaussians as viewers draw them; oracles: map.ply drawn as 3DGS does, a rigid motion, a grid by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny_run import compose

from emgs_jax.config.configure import build
from emgs_jax.device.arrays import to_se3
from emgs_jax.drawing.layers import LARGEST, closing_covariances
from emgs_jax.drawing.splats import read_splats
from emgs_jax.gaussian_map import confirmed
from emgs_jax.gaussians import Gaussians
from emgs_jax.render.composite import render
from emgs_jax.render.densify import densify
from emgs_jax.runs.finished_run import read_run

pytestmark = pytest.mark.xdist_group("tiny")


@pytest.mark.slow
def test_map_ply_drawn_as_3dgs_draws_it_closes_every_view(exact_run):
    """gsplat's convention: blur .3 px, its own opacity, up to 3.33 standard deviations; 98 % of what a view sees."""
    folder, _ = exact_run
    run, config = read_run(folder), build(compose(), "densify")
    splats, gaussians = read_splats(folder / "map.ply"), confirmed(run.map)
    arrays = splats.means, splats.covs, splats.colors[:, :3], splats.normals, np.zeros((len(splats.means), 0))
    drawn = Gaussians(*(jnp.asarray(x, jnp.float32) for x in arrays), jnp.ones(len(splats.means), bool))
    theirs = eqx.tree_at(lambda c: (c.covariance_scale, c.blur, c.radius), config.render, (1.0, 0.3, 3.33))
    theirs = jax.tree.map(jnp.float32, theirs)
    np.testing.assert_allclose(splats.colors[:, 3], float(theirs.opacity), rtol=1e-6)
    for pose in run.poses:
        seen = np.asarray(jax.jit(densify)(gaussians, to_se3(pose), run.camera, config).valid)
        picture = jax.jit(render)(drawn, drawn.colors, to_se3(pose), run.camera, theirs)
        assert seen.mean() > 0.9 and picture.overflow == 0
        assert (np.asarray(picture.alpha)[seen] > 0.9).mean() > 0.98


def hexagons(std: float, spacing: float = 0.1):
    """A plane of discs whose six neighbours are `spacing` away."""
    i, j = np.meshgrid(np.arange(9.0), np.arange(9.0), indexing="ij")
    means = np.stack([spacing * (i + 0.5 * j), spacing * np.sqrt(0.75) * j, 0 * i], -1).reshape(-1, 3)
    covs = np.broadcast_to(np.diag([std**2, std**2, 1e-4]), (len(means), 3, 3))
    return means, covs, np.broadcast_to([0.0, 0.0, 1.0], means.shape)


def test_discs_are_widened_until_their_neighbours_are_two_standard_deviations_away():
    middle = closing_covariances(*hexagons(0.02))[40]
    np.testing.assert_allclose(middle, np.diag([0.05**2, 0.05**2, 1e-4]), atol=1e-12)
    np.testing.assert_array_equal(closing_covariances(*hexagons(0.06))[40], hexagons(0.06)[1][40])


def test_one_that_stands_alone_and_another_side_of_a_sheet_make_nothing_huge_or_small():
    means, covs, normals = hexagons(0.02)
    alone = closing_covariances(np.vstack([means, [50.0, 0, 0]]), [*covs, covs[0]], [*normals, normals[0]])[-1]
    np.testing.assert_allclose(np.sqrt(np.diag(alone)), [0.02 * LARGEST, 0.02 * LARGEST, 0.01])
    both = closing_covariances(np.vstack([means, means + 1e-3]), [*covs, *covs], [*normals, *-normals])
    np.testing.assert_allclose(both[40], closing_covariances(means, covs, normals)[40], atol=1e-12)


def test_a_rigid_motion_moves_the_result_by_it():
    means, covs, normals = hexagons(0.02)
    turn = Rotation.from_rotvec([0.3, -1.0, 0.6]).as_matrix()
    moved = closing_covariances(means @ turn.T + 2.0, turn @ covs @ turn.T, normals @ turn.T)
    np.testing.assert_allclose(moved, turn @ closing_covariances(means, covs, normals) @ turn.T, atol=1e-10)


def test_free_maps_and_single_gaussians_are_left_alone():
    means, covs, normals = hexagons(0.02)
    for count in (0, 1):
        np.testing.assert_array_equal(closing_covariances(means[:count], covs[:count], normals[:count]), covs[:count])

"""The unit of a finished run: all lengths times one factor about the first camera, and what follows from them."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hand_run import run_of
from scene import assert_same, pose, random_gaussians, random_observation

from emgs_jax.gaussian_map import new_map
from emgs_jax.mapping.atlas import Submap
from emgs_jax.mapping.finalize import rescale_atlas
from emgs_jax.mapping.pipeline import with_atlas
from emgs_jax.mapping.records import FrameRecord
from emgs_jax.mapping.run import MappingRun
from emgs_jax.registration.pose_estimate import exact_estimate
from emgs_jax.slam import SlamState

LOG_SCALE = -0.1  # the map is as much too small
SAID = (0.5, -1.0, 2.0)


def a_run(log_scale: float) -> MappingRun:
    poses = [
        np.asarray(pose((0.1 * i, 0.2, -0.1 * i), (1.0 + 0.3 * i, -2.0, 0.5)).as_matrix(), float) for i in range(3)
    ]
    records = [FrameRecord(0, None, None, "initialization", pose=poses[0], scale=1.0)]
    known = {"scale": 0.9, "covariance": np.eye(6)}
    records += [FrameRecord(i, None, None, "tracked", pose=poses[i], **known) for i in (1, 2)]
    known = (jnp.asarray(log_scale), jnp.eye(7), jaxlie.SE3(jnp.tile(pose((0.3, 0, 0), SAID).wxyz_xyz, (2, 1))))
    estimate = eqx.tree_at(lambda b: (b.log_scale, b.covariance, b.repeats.predicted), exact_estimate(), known)
    map = new_map(random_gaussians(9), jnp.ones(9), jnp.ones(()), jnp.asarray(0))
    last = jaxlie.SE3.from_matrix(jnp.asarray(poses[-1], jnp.float32))
    return run_of(records, SlamState(map, random_observation(20), last, estimate, jnp.asarray(3)))


def in_unit(run: MappingRun) -> MappingRun:
    return with_atlas(run, rescale_atlas(run.atlas, run.records[0].pose))


def test_all_lengths_grow_about_the_first_camera_and_directions_stay():
    run, factor = a_run(LOG_SCALE), np.exp(-LOG_SCALE)
    before, records = run.state, run.records
    run = in_unit(run)
    after, origin = run.state, records[0].pose[:3, 3]
    grown = origin + factor * (np.asarray(before.map.gaussians.means) - origin)
    np.testing.assert_allclose(after.map.gaussians.means, grown, atol=1e-5)
    np.testing.assert_allclose(after.map.gaussians.covs, factor**2 * before.map.gaussians.covs, rtol=1e-5)
    assert_same(after.map.gaussians.normals, before.map.gaussians.normals)
    np.testing.assert_allclose(after.previous.points, origin + factor * (before.previous.points - origin), atol=1e-5)
    for old, new in zip(records, run.records, strict=True):
        np.testing.assert_allclose(new.pose[:3, 3], origin + factor * (old.pose[:3, 3] - origin), atol=1e-12)
        np.testing.assert_array_equal(new.pose[:3, :3], old.pose[:3, :3])
    assert run.records[1].scale == pytest.approx(0.9 * factor) and run.records[0].scale == pytest.approx(factor)
    np.testing.assert_allclose(after.T_world_previous.as_matrix(), run.records[2].pose, atol=1e-5)
    np.testing.assert_allclose(np.sqrt(np.diag(after.estimate.covariance)), [factor] * 3 + [1.0] * 4, rtol=1e-5)
    np.testing.assert_allclose(np.sqrt(np.diag(run.records[1].covariance)), [factor] * 3 + [1.0] * 3, rtol=1e-7)
    assert float(after.estimate.log_scale) == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(
        after.estimate.repeats.predicted.translation(), factor * np.tile(SAID, (2, 1)), rtol=1e-5
    )


def test_a_submap_that_was_never_joined_stays_with_its_poses():
    """Poses of its frames were rescaled about a camera of another world, and its map was not."""
    run = a_run(LOG_SCALE)
    atlas, here, there = run.atlas, *run.atlas.graph.nodes[:2]
    nodes = (here, replace(there, submap=1), *run.atlas.graph.nodes[2:])
    other = Submap(a_run(0.0).state)
    atlas = replace(atlas, graph=replace(atlas.graph, nodes=nodes), submaps={**atlas.submaps, 1: other})
    found = rescale_atlas(atlas, here.pose)
    assert found.graph.nodes[1] is nodes[1] and found.submaps[1] is other
    assert found.graph.nodes[2].log_scale == pytest.approx(nodes[2].log_scale - LOG_SCALE)


def test_a_map_in_the_priors_own_unit_keeps_every_bit():
    run = a_run(0.0)
    for atlas in (run.atlas, run_of(()).atlas):  # nothing was mapped
        assert rescale_atlas(atlas, np.eye(4)) is atlas


def test_a_map_of_joined_submaps_keeps_its_unit():
    """Each had one of its own, and the mean of the scales is that of the last one's inferences."""
    run = a_run(LOG_SCALE)
    atlas = replace(run.atlas, graph=replace(run.atlas.graph, has_one_unit=False))
    assert rescale_atlas(atlas, run.records[0].pose) is atlas

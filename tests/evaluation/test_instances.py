"""Objects as clusters: two blobs at known places, a chain, noise, and the limits."""

import numpy as np

from emgs_jax.evaluation.instances import InstanceConfig, clusters, find_instances, reach_of

CONFIG = InstanceConfig(reach=3.0, min_gaussians=3)


def blob(center, count: int = 4) -> np.ndarray:
    """A cube of count³ points a tenth apart, about a centre."""
    axis = 0.1 * (np.arange(count) - (count - 1) / 2)
    return np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3) + center


def test_two_blobs_are_two_objects_with_their_centres_boxes_and_scores():
    means = np.concatenate([blob([1.0, 0, 0]), blob([0, 2.0, 0], 3), [[5.0, 5.0, 5.0]], blob([0, 0, 3.0])])
    covs = np.broadcast_to(np.diag([0.01, 0.04, 0.09]), (len(means), 3, 3))
    cosines, leads = np.full(len(means), 0.5), np.full(len(means), 0.1)
    cosines[64:91], leads[64:91] = 0.9, 0.3
    answers = np.arange(92)  # the last blob is of another word
    reach = reach_of(means, CONFIG)
    np.testing.assert_allclose(reach, 0.3)
    first, second = find_instances(answers, (means, covs), (cosines, leads), reach, 3)
    np.testing.assert_array_equal(first.rows, np.arange(64))  # 64 of .5 are more than 27 of .9
    np.testing.assert_array_equal(second.rows, np.arange(64, 91))  # the lonely one is noise
    np.testing.assert_allclose(first.center, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(second.center, [0, 2, 0], atol=1e-12)
    np.testing.assert_allclose(second.low, [-0.2, 1.7, -0.4])  # .1 of the means and .1, .2, .3 of a deviation
    np.testing.assert_allclose(second.high, [0.2, 2.3, 0.4])
    np.testing.assert_allclose([second.score, second.lead, first.score], [0.9, 0.3, 0.5])
    (alone,) = find_instances(np.arange(64, 92), (means, covs), (cosines, leads), reach, 3)
    np.testing.assert_array_equal(alone.rows, second.rows)  # of the map, not of the answers


def test_what_is_within_reach_step_by_step_is_one_object_and_a_gap_parts_it():
    chain = np.stack([np.arange(10) * 0.2, np.zeros(10), np.zeros(10)], 1)
    assert clusters(chain, 0.25, 2).tolist() == [0] * 10
    assert clusters(np.delete(chain, 4, 0), 0.25, 2).tolist() == [0] * 4 + [1] * 5
    assert clusters(chain, 0.19, 2).tolist() == [-1] * 10
    none = np.zeros((0, 3)), np.zeros((0, 3, 3))  # without answers or neighbours there is no object
    assert find_instances(np.zeros(0, int), none, (np.zeros(0), np.zeros(0)), 0.3, 3) == []
    assert reach_of(np.zeros((1, 3)), CONFIG) == 0.0
    one = np.zeros((1, 3)), np.eye(3)[None]
    assert find_instances(np.zeros(1, int), one, (np.ones(1), np.ones(1)), 0.0, 1) == []

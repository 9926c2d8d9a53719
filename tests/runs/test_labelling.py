"""Classes of points by the Gaussians that explain them; oracles: densities that are written out, and literals."""

from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scene import random_gaussians

from emgs_jax.gaussian_map import new_map
from emgs_jax.runs import labelling
from emgs_jax.runs.labelling import LabelledMap, labelled_map

CLASSES = ("wall", "cup", "table")


def a_map(gaussians):
    count = gaussians.valid.shape[0]
    map = new_map(gaussians, jnp.ones(count), jnp.ones(()), jnp.asarray(0))
    return SimpleNamespace(state=SimpleNamespace(map=map))


PRIOR = SimpleNamespace(feature_names=CLASSES, text_features=np.eye(3, dtype=np.float32))


@pytest.fixture(scope="module")
def gaussians():
    rows = random_gaussians(30, seed=3, num_features=3)
    return eqx.tree_at(lambda g: g.valid, rows, jnp.arange(30) != 4)


@pytest.mark.parametrize("max_points", [7, 1000])
def test_a_point_has_the_class_that_its_nearest_gaussians_say_most_of(gaussians, max_points, monkeypatch):
    monkeypatch.setattr(labelling, "MAX_POINTS", max_points)
    blank = eqx.tree_at(lambda g: g.features, gaussians, gaussians.features.at[7].set(0.0))
    found = labelled_map(a_map(blank), PRIOR)
    known = [row for row in range(30) if row not in (4, 7)]  # no row, no feature
    points = np.random.default_rng(0).normal(size=(200, 3)) + np.asarray(gaussians.means).mean(0)
    means, covs = (np.asarray(x, float)[known] for x in (blank.means, blank.covs))
    evidence = np.asarray(blank.features, float)[known]  # the text of each class is an axis
    for point, label in zip(points, found.classes_of(points), strict=True):
        rows = np.argsort(np.linalg.norm(means - point, axis=1))[: labelling.NUM_NEIGHBOURS]
        shares = np.zeros(3)
        for k in rows:
            offset = point - means[k]
            density = np.exp(-0.5 * offset @ np.linalg.solve(covs[k], offset)) / np.sqrt(np.linalg.det(covs[k]))
            shares += density * evidence[k]
        assert shares[label] >= shares.max() - 1e-5 * np.abs(shares).max()


def test_a_wall_does_not_explain_the_cup_in_front_of_it():
    """The cup's point is nearer to the mean of the wall's Gaussian, which is flat."""
    flat, small = np.diag([0.2, 0.2, 0.01]), np.diag([0.05, 0.05, 0.05])
    map = LabelledMap(
        means=np.array([[0.0, 0, 2], [0.0, 0.12, 1.9]]),
        whiten=np.linalg.inv([flat, small]),
        log_dets=2 * np.log([0.2 * 0.2 * 0.01, 0.05**3]),
        evidence=np.eye(3)[:2],
        classes=CLASSES,
    )
    np.testing.assert_array_equal(map.classes_of(np.array([[0.0, 0.05, 1.94], [0.1, 0.0, 2.0]])), [1, 0])


@pytest.mark.parametrize(
    ("evidence", "label"),
    [
        ([[0, 1, 0], [0, 0, 9]], 2),  # nine views against one
        ([[0, 9, 0], [0, 0, 1]], 1),
        ([[0, 3, 0], [0, 4, 5]], 1),  # the second by itself is a table, both together are a cup
    ],
)
def test_what_most_views_say_decides_between_gaussians_that_explain_a_point_alike(evidence, label):
    means, round_ = np.array([[-0.1, 0, 0], [0.1, 0, 0]]), np.tile(np.eye(3), (2, 1, 1))
    map = LabelledMap(means, round_, np.zeros(2), np.array(evidence, float), CLASSES)
    np.testing.assert_array_equal(map.labels, [1, 2])
    np.testing.assert_array_equal(map.classes_of(np.zeros((1, 3))), [label])


def test_without_classes_or_features_there_is_no_labelled_map_and_without_gaussians_no_answer(gaussians):
    assert labelled_map(a_map(gaussians), SimpleNamespace(feature_names=(), text_features=None)) is None
    assert labelled_map(a_map(random_gaussians(3, num_features=0)), PRIOR) is None
    nothing = eqx.tree_at(lambda g: g.features, gaussians, jnp.zeros((30, 3)))
    np.testing.assert_array_equal(labelled_map(a_map(nothing), PRIOR).classes_of(np.zeros((2, 3))), [-1, -1])

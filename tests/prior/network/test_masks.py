"""MapAnything's masks; oracle: upstream's formulas, pixel by pixel in NumPy, and scenes whose answer is known."""

import hydra
import numpy as np
import pytest
from scene import compose

from emgs_jax.prior.network.masks import depth_edges, grid_normals, normal_edges, usable

SHAPE = (14, 17)


def config(**changes):
    return hydra.utils.instantiate(dict(compose("prior=mapanything").prior.masks) | changes)


@pytest.fixture(scope="module")
def scene():
    """Two slanted planes with a step between them, noise and holes: points, mask."""
    rng = np.random.default_rng(3)
    v, u = np.indices(SHAPE)
    depth = np.where(u + v < 15, 2 + 0.02 * u - 0.01 * v, 2.3 + 0.05 * v) + 0.004 * rng.standard_normal(SHAPE)
    points = np.stack([(u - 8.0) / 12 * depth, (v - 6.5) / 11 * depth, depth], axis=-1).astype(np.float32)
    return points, rng.uniform(size=SHAPE) > 0.12


def unit(vector):
    return vector / (np.linalg.norm(vector) + 1e-12)


def corner_normals(points, mask):
    """Upstream's points_to_normals at one pixel after the other."""
    points, (height, width) = points.astype(float), mask.shape
    normals, has_any = np.zeros_like(points), np.zeros_like(mask)
    around = [(-1, 0), (0, -1), (1, 0), (0, 1)]  # up, left, down, right; each makes a corner with the next
    for y, x in np.ndindex(*mask.shape):
        for (ay, ax), (by, bx) in zip(around, around[1:] + around[:1], strict=True):
            corners = [(y, x), (y + ay, x + ax), (y + by, x + bx)]
            if all(0 <= r < height and 0 <= c < width and mask[r, c] for r, c in corners):
                a, b = points[corners[1]] - points[y, x], points[corners[2]] - points[y, x]
                normals[y, x] += unit(np.cross(a, b))
                has_any[y, x] = True
        normals[y, x] = unit(normals[y, x])
    return normals, has_any


def neighbours(y, x):
    """The 3 × 3 pixels around, as far as they are in the image."""
    rows, columns = range(max(y - 1, 0), min(y + 2, SHAPE[0])), range(max(x - 1, 0), min(x + 2, SHAPE[1]))
    return [(r, c) for r in rows for c in columns]


def largest_angles(normals, has_normal):
    """Upstream's normals_edge: the largest angle to a neighbour with a normal, then its maximum over 3 × 3."""
    angles = np.zeros(SHAPE)
    for y, x in np.ndindex(SHAPE):
        cosines = [normals[y, x] @ normals[p] for p in neighbours(y, x) if has_normal[p]]
        angles[y, x] = np.arccos(np.clip(min(cosines, default=1.0), -1, 1))
    return np.array([[max(angles[p] for p in neighbours(y, x)) for x in range(SHAPE[1])] for y in range(SHAPE[0])])


def depth_ranges(depth, mask):
    """Upstream's depth_edge before the threshold, where the pixel is valid."""
    ranges = np.zeros(SHAPE)
    for y, x in np.argwhere(mask):
        around = [float(depth[p]) for p in neighbours(y, x) if mask[p]]
        ranges[y, x] = (max(around) - min(around)) / depth[y, x]
    return ranges


def assert_same_above(got, values, threshold, where=True):
    """Booleans agree with `values > threshold` but where float32 cannot tell."""
    decided = where & (np.abs(values - threshold) > 1e-4)
    assert decided.mean() > 0.7
    np.testing.assert_array_equal(np.asarray(got)[decided], (values > threshold)[decided])


def test_normals_normal_edges_and_depth_edges_are_upstreams(scene):
    points, mask = scene
    expected, has_any = corner_normals(points, mask)
    normals, has_normal = grid_normals(points, mask)
    np.testing.assert_array_equal(has_normal, has_any)
    np.testing.assert_allclose(normals, expected, atol=2e-4)  # differences of neighbours in float32
    angles = largest_angles(normals, has_any)
    for degrees in (5.0, 20.0, 60.0):
        got = normal_edges(points, mask, degrees)
        assert_same_above(got, angles, np.deg2rad(degrees))
        assert got.any()
    for step in (0.01, 0.03, 0.1):
        got = depth_edges(points[..., 2], mask, step)
        assert_same_above(got, depth_ranges(points[..., 2], mask), step, mask)


def test_a_constant_confidence_is_never_low():
    """A view of a network without confidence was dropped as a whole."""
    flat = np.ones((*SHAPE, 3), np.float32)
    for percentile in (0.0, 10.0, 90.0):
        assert usable(flat, flat[..., 0], flat[..., 0] > 0, config(confidence_percentile=percentile)).all()


def test_the_mask_of_a_view_is_upstreams_combination_and_neutral_values_turn_every_part_off(scene):
    points, mask = scene
    confidence = np.random.default_rng(1).uniform(1, 9, SHAPE).astype(np.float32)
    before = mask & (confidence > np.percentile(confidence, 10))
    angles = largest_angles(*corner_normals(points, before))
    ranges = depth_ranges(points[..., 2], before)
    expected = before & ~((angles > np.deg2rad(5)) & (ranges > 0.03))
    got = np.asarray(usable(points, confidence, mask, config(confidence_percentile=10)))
    decided = (np.abs(ranges - 0.03) > 1e-4) & (np.abs(angles - np.deg2rad(5)) > 1e-3)
    np.testing.assert_array_equal(got[decided], expected[decided])
    assert 0.2 < expected.sum() / before.sum() < 0.9 and decided.mean() > 0.9
    ones = np.ones(SHAPE, np.float32)
    assert usable(points, ones, mask, config(drop_ambiguous=0, max_edge_step=float("inf"))).all()
    np.testing.assert_array_equal(usable(points, ones, mask, config(max_edge_degrees=float("inf"))), mask)
    clean, far = np.asarray(usable(points, ones, mask, config())), np.ones(SHAPE, bool)
    far[4:11, 5:12] = False
    for poison in (np.nan, np.inf, -1.0, 0.0):  # a point that is none harms only its neighbours
        spoiled = points.copy()
        spoiled[7, 8] = poison
        got = np.asarray(usable(spoiled, ones, mask, config()))
        assert not got[7, 8]
        np.testing.assert_array_equal(got[far], clean[far])

"""MapAnything's masks; oracle: upstream's formulas, pixel by pixel in NumPy, and scenes whose answer is known."""

import hydra
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene import compose

from emgs_jax.prior.network import masks

SHAPE = (14, 17)
TRACES = []
normal_edges, depth_edges, above_percentile = map(
    jax.jit, (masks.normal_edges, masks.depth_edges, masks.above_percentile)
)
consistent_share, consistent, grid_normals = map(
    jax.jit, (masks.consistent_share, masks.consistent, masks.grid_normals)
)


@jax.jit
def usable(*arguments):
    TRACES.append(arguments)
    return masks.usable(*arguments)


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
    angles = largest_angles(np.asarray(normals, float), has_any)
    for degrees in (5.0, 20.0, 60.0):
        got = normal_edges(normals, has_normal, jnp.float32(degrees))
        assert_same_above(got, angles, np.deg2rad(degrees))
        assert np.asarray(got).any()
    for step in (0.01, 0.03, 0.1):
        got = depth_edges(points[..., 2], mask, jnp.float32(step))
        assert_same_above(got, depth_ranges(points[..., 2], mask), step, mask)


def test_the_percentile_is_numpys_and_zero_keeps_all():
    confidence = np.random.default_rng(0).uniform(1, 9, SHAPE).astype(np.float32)
    for percentile in (10.0, 37.5, 90.0):
        expected = confidence > np.percentile(confidence, percentile)
        np.testing.assert_array_equal(above_percentile(confidence, jnp.float32(percentile)), expected)
    assert above_percentile(confidence, jnp.float32(0.0)).all()
    for percentile in (0.0, 10.0, 90.0):  # constant: a view of a network without confidence was dropped as a whole
        assert above_percentile(jnp.ones(SHAPE), jnp.float32(percentile)).all()


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
    assert len(TRACES) == 1, "one compilation serves all thresholds"


@pytest.fixture(scope="module")
def views():
    """Three views of the wall z = 3 with other depths in places: depths, intrinsics, T_anchor_view."""
    rng = np.random.default_rng(5)
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, 3] = [(0, 0, 0), (0.4, 0.1, 0.3), (-0.3, 0, -0.4)]
    depths = 3.0 - T[:, 2, 3][:, None, None] + np.where(rng.uniform(size=(3, *SHAPE)) < 0.3, 0.4, 0.0)
    depths[1, 3:6, 4:9] = 0
    K = np.tile(np.array([[13.0, 0, 8.2], [0, 12.0, 6.1], [0, 0, 1]]), (3, 1, 1))
    K[2, 0, 0] = 14.0
    return depths, K, T


def shares(row, depths, K, T, absolute, relative):
    """Upstream's inliers / (inliers + outliers), one pixel after the other, and their number."""
    share, number = np.zeros(SHAPE), np.zeros(SHAPE, int)
    for y, x in np.argwhere(depths[row] > 0):
        point = np.append(depths[row, y, x] * (np.linalg.inv(K[row]) @ (x, y, 1)), 1)
        inliers = 0
        for other in (view for view in range(len(depths)) if view != row):
            u, v, z = K[other] @ (np.linalg.inv(T[other]) @ T[row] @ point)[:3]
            if not (z > 0 and 0 <= u / z <= SHAPE[1] - 1 and 0 <= v / z <= SHAPE[0] - 1):
                continue
            found = depths[other, round(v / z), round(u / z)]
            if found > 0:
                number[y, x] += 1
                inliers += abs(z - found) < absolute + relative * z
        share[y, x] = inliers / max(number[y, x], 1)
    return share, number


def test_the_share_of_agreeing_views_is_upstreams(views):
    arrays = [jnp.asarray(a, jnp.float32) for a in views]
    for row, relative in ((0, 0.02), (1, 0.02), (2, 0.02), (1, 0.12)):  # 40 cm decide by whose depth the share is of
        share, number = consistent_share(jnp.asarray(row), *arrays, config(consistent_depth_share=relative))
        expected_share, expected_number = shares(row, *views, 0.02, relative)
        # At a pixel's border float32 may fall to the other side.
        assert (np.asarray(number) == expected_number).mean() > 0.98
        assert (np.abs(np.asarray(share) - expected_share) < 1e-6).mean() > 0.98
        assert {0, 0.5, 1} <= set(expected_share.ravel()) and expected_number.min() == 0


def test_a_pixel_is_contradicted_by_those_that_see_it_and_not_by_those_that_do_not(views):
    _, K, T = (jnp.asarray(a, jnp.float32) for a in views)
    depths = jnp.asarray(3.0 - views[2][:, 2, 3][:, None, None] * np.ones((3, *SHAPE)), jnp.float32)
    flying = depths.at[0, 7, 8].set(2.0)
    kept = consistent(jnp.asarray(0), flying, K, T, config(min_consistent_share=0.6))
    assert not kept[7, 8] and kept.sum() == kept.size - 1
    alone = consistent(jnp.asarray(0), flying.at[1:].set(0.0), K, T, config(min_consistent_share=0.6))
    assert alone.all()

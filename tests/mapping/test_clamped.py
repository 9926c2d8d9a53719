"""Settings that act as another value are named before a run."""

import pytest
from scene import slam_config

from emgs_jax.mapping.run import clamped
from emgs_jax.ops.camera import Camera


@pytest.mark.parametrize(("given", "is_said"), [(8, True), (20, True), (169, False), (200, False)])
def test_a_setting_that_images_of_this_size_bound_is_named(given, is_said):
    """λ of 20 and of 8 made one map of images of 160×120, without a word."""
    config = slam_config("slam.observation.thin=2", f"slam.fit.points_per_gaussian={given}")
    said = clamped(config, Camera([150.0, 150.0], [79.5, 59.5], 160, 120))
    assert bool(said) == is_said and all(f"points_per_gaussian={given} makes the Gaussians of 169" in x for x in said)
    (both,) = clamped(
        slam_config("slam.em.num_neighbours=16", "slam.em.num_candidates=8"),
        Camera([150.0] * 2, [79.5, 59.5], 640, 480),
    )
    assert "num_candidates=8" in both

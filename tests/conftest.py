"""Shared by all tests of the core: shapes and types checked at every call, one small config, one small camera."""

import pytest
from jaxtyping import install_import_hook

# Before anything imports the package: every call in the tests checks its jaxtyping signature. Two modules are left out
# because their annotations do not hold: `clustering` ("h*w" of morton_order names no bound size, and the counter of
# kmeans's loop is traced, not an int) and `linalg` (mahalanobis_sq gets batches that broadcast, which needs "*#b").
CHECKED = (
    *("pytree", "linalg", "rigid", "camera", "observation", "neighbours", "clustering", "gaussians"),
    *("gaussian_map", "icp"),
    *("render", "initialization", "localization", "em", "refinement", "slam", "semantics"),
)
install_import_hook([f"emgs_jax.{name}" for name in CHECKED], "beartype.beartype")


@pytest.fixture(scope="session")
def config():
    """`config("em.noise=0", ...)`: a small SlamConfig from conf/ with Hydra overrides."""
    from scene import slam_config  # after the hook

    return slam_config


@pytest.fixture(scope="session")
def camera():
    """fx ≠ fy, cx ≠ cy, H ≠ W."""
    from emgs_jax.camera import Camera

    return Camera([20.0, 23.0], [14.5, 12.25], 32, 24)

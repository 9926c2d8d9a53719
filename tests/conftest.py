"""Shared by all tests of the core: shapes and types checked at every call, one small config, one small camera."""

import jax
import pytest
from jaxtyping import install_import_hook

# Before anything imports the package: every call in the tests checks its jaxtyping signature.
CHECKED = (
    *("pytree", "linalg", "rigid", "camera", "observation", "selection", "neighbours"),
    *("clustering", "gaussians"),
    *("gaussian_map", "icp"),
    *("render", "initialization", "localization", "em", "refinement", "slam", "semantics"),
    *("prior.masks", "stereo.bundle_adjustment", "stereo.plane_sweep", "stereo.semi_global", "stereo.depth"),
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


@pytest.fixture(autouse=True, scope="module")
def drop_executables():
    """Every executable holds memory maps, of which Linux gives a process 65530: past that, compiling segfaults."""
    yield
    jax.clear_caches()

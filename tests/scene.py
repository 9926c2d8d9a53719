"""One small config and one small scene for the tests of the core, and conversions to the NumPy truth."""

from functools import cache
from pathlib import Path

import equinox as eqx
import hydra
import jax.numpy as jnp
import jaxlie
import numpy as np
from reference import room_view

from emgs_jax.gaussians import Gaussians
from emgs_jax.observation import Observation, Prediction
from emgs_jax.ops.camera import Camera

CONF = Path(__file__).resolve().parents[1] / "conf"
# λ is 8 pixels of an image of 32 × 24, or 32 of one of 64 × 48.
SMALL = (
    *(
        "slam.observation.thin=1",
        "slam.observation.normal_radius=1",
        "slam.observation.normal_spacing=1",
        "slam.window_size=3",
    ),
    *("slam.fit.points_per_gaussian=2116", "slam.fit.num_fit_neighbours=8", "slam.fit.num_kmeans_iterations=2"),
    *("slam.submap.map_capacity=256", "slam.submap.submap_capacity=192", "slam.em.num_neighbours=6", "slam.em.num_candidates=192"),
    *("render.tile_size=8", "render.tile_capacity=192", "render.covariance_scale=2.0", "render.radius=3.0"),
    "slam.localization.icp.num_points=256",
)


@cache
def compose(*overrides: str):
    """conf/ with overrides, as Hydra composes it."""
    with hydra.initialize_config_dir(version_base=None, config_dir=str(CONF)):
        return hydra.compose("config", overrides=list(overrides))


@cache
def slam_config(*overrides: str):
    """A small SlamConfig; the only place where a config of the core is made."""
    return hydra.utils.instantiate(compose(*SMALL, *overrides).slam, _convert_="all")


@cache
def evaluation_config(*overrides: str):
    """The protocol that the overrides choose, e.g. "evaluation=mast3r"."""
    return hydra.utils.instantiate(compose(*overrides).evaluation)


def at(tree, path: str, value):
    """The config with the field at a dotted path replaced by a number."""

    def find(node):
        for name in path.split("."):
            node = getattr(node, name)
        return node

    return eqx.tree_at(find, tree, jnp.asarray(value, jnp.float32))


def pose(rotation=(0.0, 0.0, 0.0), translation=(0.0, 0.0, 0.0)) -> jaxlie.SE3:
    """SE3 from a rotation vector (rad) and a translation (m)."""
    rotation = jaxlie.SO3.exp(jnp.asarray(rotation, jnp.float32))
    return jaxlie.SE3.from_rotation_and_translation(rotation, jnp.asarray(translation, jnp.float32))


def pose_error(actual: jaxlie.SE3, expected: jaxlie.SE3) -> tuple[float, float]:
    """Distance (m) and angle (rad) between two poses."""
    difference = np.asarray((expected.inverse() @ actual).log(), float)
    return float(np.linalg.norm(difference[:3])), float(np.linalg.norm(difference[3:]))


def observe_room(T_world_camera: jaxlie.SE3, camera: Camera, num_features: int = 0, scale: float = 1.0) -> Observation:
    """The exact observation of the box room, camera frame; features are all the same unit vector."""
    matrix = np.asarray(T_world_camera.as_matrix(), float)
    focal, center = np.asarray(camera.focal, float), np.asarray(camera.center, float)
    points, normals, colors = room_view(matrix, focal, center, camera.width, camera.height)
    count = len(points)
    return Observation(
        points=jnp.asarray(points * scale, jnp.float32),
        colors=jnp.asarray(colors, jnp.float32),
        normals=jnp.asarray(normals, jnp.float32),
        features=jnp.full((count, num_features), 1.0 / np.sqrt(max(num_features, 1)), jnp.float32),
        confidence=jnp.ones(count),
        valid=jnp.ones(count, bool),
    )


def path_pose(i: int) -> jaxlie.SE3:
    """The small scene's camera path: 4 cm and under 2 degrees a frame."""
    return pose((0.02 * np.sin(i), 0.03 * i - 0.05, 0.01 * i), (0.04 * i - 0.1, 0.02 * np.cos(i), 0.02 * i))


def stack_poses(poses: list[jaxlie.SE3]) -> jaxlie.SE3:
    return jaxlie.SE3(jnp.stack([T.wxyz_xyz for T in poses]))


def predict_room(
    i: int, camera: Camera, scale: float = 1.0, has_newest: bool = True, num_features: int = 0
) -> Prediction:
    """An exact prediction of frame i of the path, but for a scale about each camera and about the anchor."""
    anchor = path_pose(0)
    poses = []
    for T in (path_pose(i - 1), path_pose(i), path_pose(i + 1)):
        local = anchor.inverse() @ T
        local = jaxlie.SE3.from_rotation_and_translation(local.rotation(), scale * local.translation())
        poses.append(anchor @ local)
    return Prediction(
        current=observe_room(path_pose(i), camera, num_features, scale),
        previous=observe_room(path_pose(i - 1), camera, num_features, scale),
        T_world_views=stack_poses(poses),
        T_world_anchor=anchor,
        has_newest=jnp.asarray(has_newest),
        is_repeat=jnp.asarray(True),
    )


def random_gaussians(count: int, seed: int = 0, num_features: int = 0, low=(-1, -1, 1), high=(1, 1, 3)) -> Gaussians:
    """Anisotropic Gaussians in a box, all valid; standard deviations of 3 to 20 cm."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    stds = rng.uniform(0.03, 0.2, (count, 3))
    unit = lambda v: v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)  # noqa: E731
    arrays = (
        rng.uniform(low, high, (count, 3)),
        np.einsum("nij,nj,nkj->nik", axes, stds**2, axes),
        rng.uniform(0, 1, (count, 3)),
        unit(rng.normal(size=(count, 3)) * 0.3 + [0, 0, -1]),
        unit(rng.normal(size=(count, num_features))),
    )
    return Gaussians(*(jnp.asarray(a, jnp.float32) for a in arrays), jnp.ones(count, bool))


def as_numpy(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Float64 arrays by name, for tests/reference.py."""
    names = ("means", "covs", "colors", "normals", "features")
    return {name: np.asarray(getattr(gaussians, name), float) for name in names} | {
        "valid": np.asarray(gaussians.valid)
    }


def move_gaussians(T: jaxlie.SE3, g: Gaussians) -> Gaussians:
    """A rigid motion of Gaussians."""
    R = T.rotation().as_matrix()
    moved = g.means @ R.T + T.translation(), R @ g.covs @ R.T, g.normals @ R.T
    return eqx.tree_at(lambda x: (x.means, x.covs, x.normals), g, moved)


def random_observation(count: int, seed: int = 0, num_features: int = 0) -> Observation:
    """World-frame points in the box of `random_gaussians`."""
    g = random_gaussians(count, seed + 1000, num_features)
    return Observation(g.means, g.colors, g.normals, g.features, jnp.ones(count), jnp.ones(count, bool))


def assert_same(actual, expected):
    """Equal trees, bit for bit."""
    assert eqx.tree_equal(actual, expected), (actual, expected)

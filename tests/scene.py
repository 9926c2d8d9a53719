"""One small config and one small scene for the tests of the core, and what tests do with arrays, in NumPy."""

from functools import cache, reduce
from pathlib import Path

import equinox as eqx
import hydra
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from reference import room_view
from scipy.spatial.transform import Rotation

from emgs_jax.config import configure
from emgs_jax.em import EStep
from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.gaussians import Gaussians
from emgs_jax.mapping.convert import FirstWindow
from emgs_jax.observation import Observation, Prediction, no_covariance, unknown_scale
from emgs_jax.ops.camera import Camera
from emgs_jax.ops.neighbours import Nearby

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
    *(
        "slam.submap.map_capacity=256",
        "slam.submap.submap_capacity=192",
        "slam.em.num_neighbours=6",
        "slam.em.num_candidates=192",
    ),
    *("render.tile_size=8", "render.tile_capacity=192", "render.covariance_scale=2.0", "render.radius=3.0"),
    "slam.localization.icp.num_points=256",
)
# For whole steps. Every second row and column of the full images is kept; 32 of their pixels make 8 rows.
FULL, ROOM = Camera([40.0, 46.0], [29.0, 24.5], 64, 48), 200  # rows of the map
THINNED = Camera([20.0, 23.0], [14.5, 12.25], 32, 24)  # of its rows
WHOLE = (
    *("slam.submap.margin=100", "slam.observation.thin=2", "slam.fit.points_per_gaussian=2116"),
    *(f"slam.submap.map_capacity={ROOM}", "slam.submap.submap_capacity=256"),  # the whole map
    "slam.initialization=merged",
)


@cache
def compose(*overrides: str):
    """conf/ with overrides, as Hydra composes it."""
    return configure.compose(*overrides)


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

    return eqx.tree_at(find, tree, jnp.asarray(np.float32(value)))


def changed(tree, **values):
    """The config with several fields replaced: changed(config, **{"average.gain": 0.0})."""
    for path, value in values.items():
        tree = at(tree, path, value)
    return tree


# An operation on a JAX array that stands alone is a program of its own, some 25 ms to compile for every shape: what
# tests prepare and look at is done in NumPy.


def on_host(function):
    """The function, compiled once for each shape, with NumPy arrays for results."""
    compiled = eqx.filter_jit(function)
    return lambda *arguments: jax.device_get(compiled(*arguments))


def device(values) -> jax.Array:
    """Float32, where it is no array of integers or booleans."""
    values = np.asarray(values)
    return jnp.asarray(values.astype(np.float32) if values.dtype == np.float64 else values)


def replace(tree, **leaves):
    """The tree with these attributes replaced by arrays."""
    names = tuple(leaves)
    return eqx.tree_at(lambda x: tuple(getattr(x, name) for name in names), tree, tuple(map(device, leaves.values())))


def rows_of(tree, rows):
    """These rows of every leaf, as NumPy arrays."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[rows], tree)


def join(*trees):
    """All rows of every leaf, one tree after the other."""
    return jax.tree.map(lambda *leaves: device(np.concatenate(leaves)), *trees)


def stack(trees):
    """Every tree a row."""
    return jax.tree.map(lambda *leaves: device(np.stack(leaves)), *trees)


def poisoned(tree, valid, value):
    """All numbers of rows that are not valid replaced by a wild one; integers and booleans stay."""

    def put(leaf):
        leaf = np.asarray(leaf)
        mask = np.asarray(valid).reshape(-1, *[1] * (leaf.ndim - 1))
        return device(np.where(mask, leaf, np.float32(value)) if leaf.dtype == np.float32 else leaf)

    return jax.tree.map(put, tree)


def matrix_of(T: jaxlie.SE3) -> np.ndarray:
    """(4, 4), float64."""
    matrix, values = np.eye(4), np.asarray(T.wxyz_xyz, float)
    matrix[:3, :3] = Rotation.from_quat(np.roll(values[:4], -1)).as_matrix()
    matrix[:3, 3] = values[4:]
    return matrix


def pose_of(matrix: np.ndarray) -> jaxlie.SE3:
    """SE3 of a matrix (4, 4)."""
    quaternion = np.roll(Rotation.from_matrix(matrix[:3, :3]).as_quat(canonical=True), 1)
    return jaxlie.SE3(device(np.concatenate([quaternion, matrix[:3, 3]])))


def product(*poses: jaxlie.SE3) -> jaxlie.SE3:
    """Of poses, the last one applied first."""
    return pose_of(reduce(np.matmul, map(matrix_of, poses), np.eye(4)))


def pose(rotation=(0.0, 0.0, 0.0), translation=(0.0, 0.0, 0.0)) -> jaxlie.SE3:
    """SE3 from a rotation vector (rad) and a translation (m)."""
    quaternion = np.roll(Rotation.from_rotvec(np.asarray(rotation, float)).as_quat(), 1)
    return jaxlie.SE3(device(np.concatenate([quaternion, np.asarray(translation, float)])))


def pose_error(actual: jaxlie.SE3, expected: jaxlie.SE3) -> tuple[float, float]:
    """Distance (m) and angle (rad) between two poses."""
    one, other = np.asarray(actual.wxyz_xyz, float), np.asarray(expected.wxyz_xyz, float)
    turns = [Rotation.from_quat(np.roll(values[:4], -1)) for values in (one, other)]
    return float(np.linalg.norm(one[4:] - other[4:])), float((turns[1].inv() * turns[0]).magnitude())


def observe_room(T_world_camera: jaxlie.SE3, camera: Camera, num_features: int = 0, scale: float = 1.0) -> Observation:
    """The exact observation of the box room, camera frame; features are all the same unit vector."""
    focal, center = np.asarray(camera.focal, float), np.asarray(camera.center, float)
    points, normals, colors = room_view(matrix_of(T_world_camera), focal, center, camera.width, camera.height)
    count = len(points)
    features = np.full((count, num_features), 1.0 / max(num_features, 1) ** 0.5)
    arrays = scale * points, colors, normals, features, np.ones(count), np.ones(count, bool)
    return Observation(*map(device, arrays))


def moved_points(T: jaxlie.SE3, observation: Observation, scale: float = 1.0) -> Observation:
    """What `transform` says, in float64: points scaled about the camera and placed, normals turned."""
    matrix = matrix_of(T)
    points, normals = (np.asarray(x, float) for x in (observation.points, observation.normals))
    placed = float(scale) * points @ matrix[:3, :3].T + matrix[:3, 3]
    return replace(observation, points=placed, normals=normals @ matrix[:3, :3].T)


def path_pose(i: float) -> jaxlie.SE3:
    """The small scene's camera path: 4 cm and under 2 degrees a frame."""
    return pose((0.02 * np.sin(i), 0.03 * i - 0.05, 0.01 * i), (0.04 * i - 0.1, 0.02 * np.cos(i), 0.02 * i))


def stack_poses(poses: list[jaxlie.SE3]) -> jaxlie.SE3:
    return jaxlie.SE3(device(np.stack([T.wxyz_xyz for T in poses])))


def first_window(views: Observation, T_world_views: jaxlie.SE3) -> FirstWindow:
    """The first window of a prior that does not say how sure its poses are."""
    unknown = (jnp.tile(one, (len(views.valid), *[1] * one.ndim)) for one in (no_covariance(), unknown_scale()))
    return FirstWindow(views, T_world_views, *unknown)


def predict_room(
    i: float, camera: Camera, scale: float = 1.0, has_newest: bool = True, num_features: int = 0
) -> Prediction:
    """An exact prediction of frame i of the path, but for a scale about each camera and about the anchor."""
    anchor = matrix_of(path_pose(0))
    poses = []
    for T in (path_pose(i - 1), path_pose(i), path_pose(i + 1)):
        local = np.linalg.inv(anchor) @ matrix_of(T)
        local[:3, 3] *= scale
        poses.append(pose_of(anchor @ local))
    return Prediction(
        current=observe_room(path_pose(i), camera, num_features, scale),
        previous=observe_room(path_pose(i - 1), camera, num_features, scale),
        T_world_views=stack_poses(poses),
        T_world_anchor=path_pose(0),
        pose_covariance=no_covariance(),
        scale_std=unknown_scale(),
        has_newest=jnp.asarray(has_newest),
        is_repeat=jnp.asarray(True),
    )


def exact(i, **more) -> Prediction:
    """`predict_room` with two features, for whole steps."""
    return predict_room(i, THINNED, num_features=2, **more)


def errors_of(shape, rng):
    """A smooth image of errors of deviation 1, as predictions have them."""
    y, x = np.meshgrid(np.linspace(0, np.pi, shape[0]), np.linspace(0, np.pi, shape[1]), indexing="ij")
    waves = [(v, u) for v in range(3) for u in range(3)]
    weights = rng.normal(size=len(waves))
    image = sum(w * np.cos(v * y) * np.cos(u * x) for w, (v, u) in zip(weights, waves, strict=True))
    return (image / np.linalg.norm(weights) * 2).reshape(-1, 1)


def noisy(observation, camera, rng, depth_noise):
    """Depths that are wrong by a fraction, smoothly over the image."""
    factor = 1 + depth_noise * errors_of((camera.height, camera.width), rng)
    return replace(observation, points=observation.points * factor)


def noisy_prediction(i, camera, rng, depth_noise=0.02, scale_noise=0.02, pose_noise=(0.01, 0.005)):
    """One call's errors: a scale, depths of each image, and poses by centimetres and milliradians."""
    given = exact(i, scale=1 + scale_noise * rng.normal())
    off = [pose(pose_noise[1] * rng.normal(size=3), pose_noise[0] * rng.normal(size=3)) for _ in range(3)]
    views = map(jaxlie.SE3, np.asarray(given.T_world_views.wxyz_xyz))
    poses = stack_poses([product(T, error) for T, error in zip(views, off, strict=True)])
    images = (noisy(o, camera, rng, depth_noise) for o in (given.current, given.previous))
    return eqx.tree_at(lambda p: (p.current, p.previous, p.T_world_views), given, (*images, poses))


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
        np.ones(count, bool),
    )
    return Gaussians(*map(device, arrays))


def flat_gaussians(means, std=0.05, normal=(0.0, 0.0, -1.0), thickness=0.01, color=0.5, features=()) -> Gaussians:
    """Round discs, all with one normal, as wide as `std` and less thick."""
    means = np.atleast_2d(np.asarray(means, float))
    count, normal = len(means), np.asarray(normal, float) / np.linalg.norm(normal)
    across = np.outer(normal, normal)
    cov = std**2 * (np.eye(3) - across) + thickness**2 * across
    every = lambda row: np.broadcast_to(np.asarray(row, float), (count, *np.shape(row)[-1:]))  # noqa: E731
    arrays = means, np.tile(cov, (count, 1, 1)), every(np.broadcast_to(color, 3)), every(normal), every(features)
    return Gaussians(*map(device, arrays), device(np.ones(count, bool)))


def fresh_map(gaussians: Gaussians, weight=1.0, existence=1.0, birth=0) -> GaussianMap:
    """A map of Gaussians that were fused once; weight, existence and birth are one for all or one for each."""
    count = gaussians.valid.shape[0]
    weight, existence = (np.broadcast_to(np.asarray(x, float), count) for x in (weight, existence))
    births = np.broadcast_to(np.asarray(birth, np.int32), count)
    updates = np.ones(count, np.int32)
    return GaussianMap(gaussians, *map(device, (weight, updates, existence, births, np.zeros(count))))


def as_numpy(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Float64 arrays by name, for tests/reference.py."""
    names = ("means", "covs", "colors", "normals", "features")
    return {name: np.asarray(getattr(gaussians, name), float) for name in names} | {
        "valid": np.asarray(gaussians.valid)
    }


def move_gaussians(T: jaxlie.SE3, g: Gaussians) -> Gaussians:
    """A rigid motion of Gaussians."""
    R, t = (lambda matrix: (matrix[:3, :3], matrix[:3, 3]))(matrix_of(T))
    means, covs, normals = (np.asarray(x, float) for x in (g.means, g.covs, g.normals))
    return replace(g, means=means @ R.T + t, covs=R @ covs @ R.T, normals=normals @ R.T)


def random_observation(count: int, seed: int = 0, num_features: int = 0) -> Observation:
    """World-frame points in the box of `random_gaussians`."""
    g = random_gaussians(count, seed + 1000, num_features)
    ones = map(device, (np.ones(count), np.ones(count, bool)))
    return Observation(g.means, g.colors, g.normals, g.features, *ones)


def assert_same(actual, expected):
    """Equal trees, bit for bit."""
    leaves, structure = jax.tree.flatten(actual)
    others, other_structure = jax.tree.flatten(expected)
    assert structure == other_structure, (structure, other_structure)
    for one, other in zip(map(np.asarray, leaves), map(np.asarray, others), strict=True):
        is_float = np.issubdtype(one.dtype, np.floating)
        assert one.dtype == other.dtype and np.array_equal(one, other, equal_nan=is_float), (one, other)


def same_bits(tree, other) -> bool:
    pairs = zip(jax.tree.leaves(tree), jax.tree.leaves(other), strict=True)
    return all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in pairs)


def assert_rows_near(actual, expected, atol, names=("means", "covs", "normals", "colors")):
    """These fields of two trees, within one tolerance."""
    for name in names:
        np.testing.assert_allclose(getattr(actual, name), getattr(expected, name), atol=atol, err_msg=name)


def explained(rows, responsibilities, is_fused) -> EStep:
    """An E-step of points, each a block by itself, of which the Gaussians and their shares are given (m, k)."""
    rows, shares = device(np.int32(rows)), device(np.float32(responsibilities))
    queries, nothing = jnp.arange(len(rows))[:, None], jnp.zeros(len(rows))
    return EStep(Nearby(queries, rows, rows >= 0, nothing), shares[:, None], device(np.asarray(is_fused, bool)))


def shares_of(step: EStep, num_gaussians: int) -> np.ndarray:
    """Responsibilities of every Gaussian for every point (m, n)."""
    shares = np.zeros((len(step.is_fused) + 1, num_gaussians))  # room in a block is a point past the last
    queries, rows = np.asarray(step.near.queries)[:, :, None], np.asarray(step.near.rows)[:, None]
    np.add.at(shares, (queries, rows), np.asarray(step.responsibilities))
    return shares[:-1]

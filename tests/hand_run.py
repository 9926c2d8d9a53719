"""A run that is made by hand: a map whose content is known, frames of every status, poses that all differ."""

from dataclasses import replace
from types import SimpleNamespace

import hydra
import jax.numpy as jnp
import numpy as np
from scene import compose
from scipy.spatial.transform import Rotation

from emgs_jax.back_end.state import BackEnd, Node
from emgs_jax.gaussian_map import new_map
from emgs_jax.gaussians import Gaussians
from emgs_jax.geometry import Sim3
from emgs_jax.mapping.atlas import Atlas, Submap
from emgs_jax.mapping.records import IN_MAP, FrameRecord
from emgs_jax.mapping.run import MappingRun
from emgs_jax.ops.camera import Camera

STATUSES = ("initialization", "tracked", "degraded", "lost", "tracked", "tracked")


def wall(low: float, high: float, num_free: int = 5) -> Gaussians:
    """Gaussians on the plane z = 2 from x = low to x = high, 10 cm apart, facing z = 0; red is x / 20, green .25.

    Every other of the first rows is free and holds what must never be seen.
    """
    x, y = np.meshgrid(np.arange(low + 0.05, high, 0.1), np.arange(-0.95, 1.0, 0.1), indexing="ij")
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=1)
    colors = np.stack([means[:, 0] / 20.0, np.full(x.size, 0.25), np.full(x.size, 0.5)], axis=1)
    features = np.where(means[:, :1] < 0.5 * (low + high), [1.0, 0.0], [0.0, 1.0])
    free = np.arange(num_free) * 2
    position = np.setdiff1d(np.arange(num_free + len(means)), free)

    def rows(values, poison):
        out = np.full((len(means) + num_free, *values.shape[1:]), poison, np.float32)
        out[position] = values
        return jnp.asarray(out)

    return Gaussians(
        means=rows(means, 0.7),
        covs=rows(np.broadcast_to(np.diag([4e-3, 4e-3, 1e-4]), (len(means), 3, 3)), 0.9),
        colors=rows(colors, 0.9),
        normals=rows(np.broadcast_to([0.0, 0.0, -1.0], means.shape), 0.9),
        features=rows(features, -3.0),
        valid=rows(np.ones(len(means)), 0.0) > 0,
    )


def poses_along(xs) -> np.ndarray:
    """Cameras at these x that look at the wall, (n, 4, 4)."""
    poses = np.tile(np.eye(4), (len(xs), 1, 1))
    poses[:, 0, 3] = xs
    return poses


def random_poses(rng, count: int) -> np.ndarray:
    """Poses (n, 4, 4) about the origin."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = Rotation.random(count, rng).as_matrix(), rng.normal(size=(count, 3))
    return poses


def random_similarity(rng, scale: float) -> Sim3:
    return Sim3(scale, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))


def hand_run(poses, raw_poses, true_poses, statuses=STATUSES, gaussians=None) -> SimpleNamespace:
    """A finished run, as far as reports look at it; frame i is number i, taken at 100 + i / 4 seconds."""
    gaussians = wall(0.0, 1.0) if gaussians is None else gaussians
    count = gaussians.valid.shape[0]
    map = new_map(gaussians, jnp.ones(count), jnp.ones(()), jnp.asarray(0))
    records = [
        FrameRecord(index=i, name=f"{i}.png", timestamp=100.0 + i / 4, status=status)
        for i, status in enumerate(statuses)
    ]
    return SimpleNamespace(
        camera=Camera((24.0, 24.0), (11.5, 7.5), 24, 16),
        config=SimpleNamespace(submap=SimpleNamespace(map_capacity=count)),
        state=SimpleNamespace(map=map),
        map=map,
        records=records,
        poses=[*poses],
        raw_poses=[*raw_poses],
        true_poses=[*true_poses],
        back_end=None,
        apart={},
    )


def densify_config(*overrides: str):
    """How the wall becomes points."""
    return hydra.utils.instantiate(compose("render.tile_size=8", "render.tile_capacity=256", *overrides).densify)


def atlas_of(records, state=None, config=None, graph=None, **fields) -> Atlas:
    """An atlas whose nodes are the frames of these records, in `graph` where one is given."""

    def node(record: FrameRecord) -> Node:
        is_tracked = record.status == "tracked"
        known = {"covariance": record.covariance, "origin": record.origin}
        known["depth_noise"] = record.depth_noise if is_tracked else None
        scale = np.log(record.scale or 1.0)
        return Node(record.pose, record.pose, scale, record.index, is_placed=record.status in IN_MAP, **known)

    graph = BackEnd(None, (1.0, 1.0, 0.0, 0.0), 0.0) if graph is None else graph
    submaps = {} if state is None else {0: Submap(state)}
    return Atlas(None, config, replace(graph, nodes=tuple(map(node, records))), submaps, **fields)


def run_of(records, *parts, **fields) -> MappingRun:
    """A run with these records, see `atlas_of`."""
    return MappingRun(atlas_of(records, *parts, **fields), records=tuple(records))

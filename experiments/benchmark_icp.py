"""Registration beside Open3D's: the same points and starts, and how far each ends from the truth."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.gaussians import Gaussians, cluster, spacing
from emgs_jax.observation import Observation, transform
from emgs_jax.ops.camera import downscale
from emgs_jax.ops.clustering import morton_order
from emgs_jax.ops.precision import full_precision
from emgs_jax.registration.icp import icp
from emgs_jax.registration.problem import CoarseStart

from .timing import Candidate, Data, Timing, called, compare, interleaved, spread


@full_precision
def time_icp(data: Data, offset: tuple[float, float], repetitions: int) -> list[Timing]:
    """Coloured ICP against Open3D: every view but the first on the Gaussians of the first, from starts that are off."""
    config = data.config.localization.icp
    # Coloured residuals only, without a prior on the pose or a scale, and never done before the last step.
    config = eqx.tree_at(lambda c: (c.residual, c.prior_information, c.scale_noise), config, (jnp.zeros(()),) * 3)
    verb, target, num_steps = eqx.filter_jit(icp), _target(data), config.num_searches * config.max_steps
    rows = range(1, len(data.true_poses))
    views, truth = [_view(data, row)[1] for row in rows], [_truth(data, row) for row in rows]
    starts = [_moved(pose, offset, row) for row, pose in zip(rows, truth, strict=True)]
    arguments = [
        (view, target, CoarseStart(start, jnp.eye(7), jnp.asarray(0.01), jnp.asarray(False)), config)
        for view, start in zip(views, starts, strict=True)
    ]
    stride = max(views[0].valid.shape[0] // config.num_points, 1)
    surface = _cloud(target, target.means)
    clouds = [_cloud(view, view.points, stride) for view in views]
    others = [(cloud, surface, start.as_matrix(), num_steps) for cloud, start in zip(clouds, starts, strict=True)]
    facts = {"points": len(clouds[0].points), "gaussians": len(surface.points), "steps": num_steps}
    facts |= {"start_cm": 100.0 * offset[0], "start_deg": float(np.degrees(offset[1])), "views": len(views)}
    ours = called(verb, *arguments[0])
    ours.facts.update(facts | _errors([np.asarray(verb(*given)[0].as_matrix(), float) for given in arguments], truth))
    theirs = _errors([colored_icp(*given) for given in others], truth)
    candidates = {"emgs_jax": ours, "Open3D": Candidate(lambda: colored_icp(*others[0]), None, theirs)}
    return compare(interleaved("icp", candidates, repetitions), "Open3D")


def colored_icp(source: Any, target: Any, start: jax.Array, num_steps: int, reach: float = 0.1) -> np.ndarray:
    """Open3D's coloured ICP of two clouds for exactly `num_steps` iterations; T_target_source (4, 4).

    Args:
        start: T_target_source (4, 4).
        reach: m; farther points are no pair.
    """
    from open3d.pipelines import registration

    estimation = registration.TransformationEstimationForColoredICP()
    criteria = registration.ICPConvergenceCriteria(0.0, 0.0, num_steps)
    first = np.asarray(start, float)
    return registration.registration_colored_icp(source, target, reach, first, estimation, criteria).transformation


def _cloud(tree: Observation | Gaussians, points: jax.Array, stride: int = 1) -> Any:
    """Open3D's cloud of every so many rows, those that are valid."""
    import open3d

    vectors, valid = open3d.utility.Vector3dVector, np.asarray(tree.valid)[::stride]
    points, colors, normals = (
        vectors(np.asarray(x, float)[::stride][valid]) for x in (points, tree.colors, tree.normals)
    )
    cloud = open3d.geometry.PointCloud(points)
    cloud.colors, cloud.normals = colors, normals
    return cloud


def _view(data: Data, row: int) -> tuple[jaxlie.SE3, Observation]:
    """One view of the first window: the prior's pose, and the points in the camera's frame."""
    return jax.tree.map(lambda leaf: leaf[row], (data.first.T_world_views, data.first.views))


def _target(data: Data) -> Gaussians:
    """The Gaussians of the first view alone, world frame."""
    config, view = data.config, downscale(data.camera, data.config.observation.thin)
    points = transform(*_view(data, 0), jnp.ones(()))
    num_rows = spacing(data.camera, config.observation.thin, config.fit)
    return cluster(points, morton_order(view.height, view.width), num_rows, config.fit)[0]


def _truth(data: Data, row: int) -> np.ndarray:
    """True pose of a view, in the world in which the first view is where the prior has it, as the Gaussians are."""
    T_world_first = np.asarray(_view(data, 0)[0].as_matrix(), float)
    return T_world_first @ np.linalg.inv(data.true_poses[0]) @ data.true_poses[row]


def _moved(pose: np.ndarray, offset: tuple[float, float], seed: int) -> jaxlie.SE3:
    """A pose that is `offset` (m, rad) away, in directions that are drawn."""
    directions = np.random.default_rng(seed).normal(size=(2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    xi = (np.array(offset)[:, None] * directions).ravel()
    return jaxlie.SE3.from_matrix(jnp.asarray(pose, jnp.float32)) @ jaxlie.SE3.exp(jnp.asarray(xi, jnp.float32))


def _errors(found: Sequence[np.ndarray], truth: Sequence[np.ndarray]) -> dict[str, Any]:
    errors = [np.linalg.inv(true) @ pose for pose, true in zip(found, truth, strict=True)]
    angles = [np.degrees(np.linalg.norm(jaxlie.SE3.from_matrix(jnp.asarray(e)).log()[3:])) for e in errors]
    return {
        "translation_error_cm": spread([100.0 * float(np.linalg.norm(error[:3, 3])) for error in errors]),
        "rotation_error_deg": spread([float(angle) for angle in angles]),
    }

"""Registration beside Open3D's: the same points and starts, and how far each ends from the truth."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.gaussians import Gaussians, cluster, spacing
from emgs_jax.observation import Observation, transform
from emgs_jax.ops.clustering import morton_order
from emgs_jax.ops.pytree import take_rows
from emgs_jax.registration.icp import icp
from emgs_jax.registration.problem import CoarseStart

from .data import Data, view
from .timing import Candidate, Timing, called, compare, interleaved, spread

Arrays = Mapping[str, np.ndarray]  # the fields of Gaussians or of an Observation, valid rows only


def colored_icp(source: Arrays, target: Arrays, start: np.ndarray, reach: float, num_steps: int) -> np.ndarray:
    """Open3D's coloured ICP for exactly `num_steps` iterations; T_target_source (4, 4).

    Args:
        source: points and colors.
        target: points, normals and colors.
        start: T_target_source (4, 4).
        reach: m; farther points are no pair.
    """
    import open3d

    registration = open3d.pipelines.registration
    clouds = []
    for arrays in (source, target):
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(arrays["points"]))
        cloud.colors = open3d.utility.Vector3dVector(arrays["colors"])
        cloud.normals = open3d.utility.Vector3dVector(arrays["normals"])
        clouds.append(cloud)
    estimation = registration.TransformationEstimationForColoredICP()
    criteria = registration.ICPConvergenceCriteria(0.0, 0.0, num_steps)
    return registration.registration_colored_icp(*clouds, reach, start, estimation, criteria).transformation


def _host(tree: eqx.Module) -> dict[str, np.ndarray]:
    """The fields of a module as NumPy arrays; only the valid rows."""
    arrays = {name: np.asarray(value) for name, value in vars(tree).items() if eqx.is_array(value)}
    return {name: value[arrays["valid"]] for name, value in arrays.items()}


def time_icp(data: Data, offset: tuple[float, float], repetitions: int) -> list[Timing]:
    """Coloured ICP against Open3D: every view but the first on the Gaussians of the first, from starts that are off."""
    config = data.config.localization.icp
    # Coloured residuals only, without a prior on the pose or a scale, and never done before the last step.
    config = eqx.tree_at(lambda c: (c.residual, c.prior_information, c.scale_noise), config, (jnp.zeros(()),) * 3)
    _, reference = view(data, 0)
    count = reference.valid.shape[0] // spacing(data.camera, data.config.observation.thin, data.config.fit)
    target = gaussians_of(data, 3 * count // 4)
    stride = max(reference.valid.shape[0] // config.num_points, 1)
    cases = [_icp_case(data, row, offset) for row in range(1, len(data.true_poses))]
    starts = [CoarseStart(start, jnp.eye(7), jnp.asarray(0.01), jnp.asarray(False)) for _, start, _ in cases]
    arguments = [(case[0], target, start, config) for case, start in zip(cases, starts, strict=True)]
    verb = eqx.filter_jit(icp)
    ours = called(verb, *arguments[0])
    clouds = [
        (_host(jax.tree.map(lambda leaf: leaf[::stride], points)), start.as_matrix()) for points, start, _ in cases
    ]
    surface = _host(target) | {"points": _host(target)["means"]}
    reach, num_steps = 0.1, config.num_searches * config.max_steps

    def open3d_one() -> np.ndarray:
        return colored_icp(clouds[0][0], surface, np.asarray(clouds[0][1], float), reach, num_steps)

    truth = [case[2] for case in cases]
    mine = [np.asarray(verb(*each)[0].as_matrix(), float) for each in arguments]
    theirs = [colored_icp(cloud, surface, np.asarray(start, float), reach, num_steps) for cloud, start in clouds]
    ours.facts.update(points=len(clouds[0][0]["points"]), gaussians=len(surface["points"]), steps=num_steps)
    ours.facts.update(start_cm=100.0 * offset[0], start_deg=float(np.degrees(offset[1])), views=len(cases))
    ours.facts.update(_pose_errors(mine, truth))
    candidates = {"emgs_jax": ours, "Open3D": Candidate(open3d_one, None, _pose_errors(theirs, truth))}
    return compare(interleaved("icp", candidates, repetitions), "Open3D")


def gaussians_of(data: Data, count: int) -> Gaussians:
    """`count` Gaussians that the first view is clustered into, world frame; fewer where it gives no more."""
    T, observation = view(data, 0)
    camera, thin = data.camera, data.config.observation.thin
    order = morton_order(-(-camera.height // thin), -(-camera.width // thin))
    spacing = max(int(observation.valid.sum()) // (count + count // 8), 1)  # some clusters stay empty
    config = data.config.fit
    fitted, _ = eqx.filter_jit(cluster)(transform(T, observation, jnp.ones(())), order, spacing, config)
    rows = np.flatnonzero(np.asarray(fitted.valid))
    return take_rows(fitted, jnp.asarray(rows[np.linspace(0, len(rows) - 1, min(count, len(rows))).astype(int)]))


def _icp_case(data: Data, row: int, offset: tuple[float, float]) -> tuple[Observation, jaxlie.SE3, np.ndarray]:
    """Points of a view, a start that is `offset` (m, rad) away from the truth, and the truth."""
    _, points = view(data, row)
    # The frame of the first view as the prior has it, which is where the Gaussians are.
    T_world_first = np.asarray(view(data, 0)[0].as_matrix(), float)
    truth = T_world_first @ np.linalg.inv(data.true_poses[0]) @ data.true_poses[row]
    random = np.random.default_rng(row)
    directions = [axis / np.linalg.norm(axis) for axis in random.normal(size=(2, 3))]
    xi = np.concatenate([size * axis for size, axis in zip(offset, directions, strict=True)])
    start = jaxlie.SE3.from_matrix(jnp.asarray(truth, jnp.float32)) @ jaxlie.SE3.exp(jnp.asarray(xi, jnp.float32))
    return points, start, truth


def _pose_errors(found: list[np.ndarray], truth: list[np.ndarray]) -> dict[str, Any]:
    errors = [np.linalg.inv(true) @ pose for pose, true in zip(found, truth, strict=True)]
    angles = [np.degrees(np.linalg.norm(jaxlie.SE3.from_matrix(jnp.asarray(e)).log()[3:])) for e in errors]
    return {
        "translation_error_cm": spread([100.0 * float(np.linalg.norm(error[:3, 3])) for error in errors]),
        "rotation_error_deg": spread([float(angle) for angle in angles]),
    }

"""Stages beside what a user would pick instead: the same data and work, and how far the results differ."""

import importlib.util
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from emgs_jax.em import e_step, m_step
from emgs_jax.gaussians import Gaussians, spacing
from emgs_jax.observation import Observation, transform
from emgs_jax.ops.camera import downscale
from emgs_jax.ops.neighbours import of_queries
from emgs_jax.ops.pytree import take_rows
from emgs_jax.registration.icp import icp
from emgs_jax.registration.problem import CoarseStart
from emgs_jax.render.composite import render
from emgs_jax.render.project import project_gaussians

from . import baselines
from .data import Data, gaussians_of, view
from .timing import Candidate, Timing, compare, executable, interleaved, spread

MAX_PAIRS = 2**26  # of a splat and a pixel, without tiles: a second or two


def _host(tree: eqx.Module, valid: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """The fields of a module as NumPy arrays; only the valid rows."""
    arrays = {name: np.asarray(value) for name, value in vars(tree).items() if eqx.is_array(value)}
    keep = arrays["valid"] if valid is None else valid
    return {name: value[keep] for name, value in arrays.items()}


def time_em(data: Data, num_gaussians: int, repetitions: int) -> list[Timing]:
    """E-step and M-step against NumPy and SciPy, on all pixels of the second view."""
    gaussians, config = gaussians_of(data, num_gaussians), data.config.em
    T, observation = view(data, 1)
    points = transform(T, observation, jnp.ones(()))
    points = take_rows(points, jnp.flatnonzero(points.valid))
    noise = 0.01 * (points.points - T.translation())  # one percent of the depth

    def both(gaussians: Gaussians, points: Observation, noise: jax.Array, config: Any) -> Any:
        found, _ = e_step(gaussians, points, noise, config)
        return found, m_step(gaussians, points, jnp.ones(points.valid.shape), found, config)

    ours = executable(both, gaussians, points, noise, config)
    theirs = (_host(gaussians), _host(points), np.asarray(noise), config)
    ours.facts.update(_em_difference(ours.call(), baselines.em(*theirs)))
    ours.facts.update(points=points.valid.shape[0], gaussians=num_gaussians)
    candidates = {"emgs_jax": ours, "NumPy + SciPy": Candidate(lambda: baselines.em(*theirs))}
    return compare(interleaved("em", candidates, repetitions), "NumPy + SciPy")


def _em_difference(ours: Any, theirs: baselines.Update) -> dict[str, float]:
    found, (new, _) = ours
    r, shape = found.responsibilities, found.responsibilities.shape
    listed = jnp.broadcast_to(found.near.rows[:, None], shape)
    rows, r = (np.asarray(of_queries(found.near, values, len(theirs.rows))) for values in (listed, r))
    is_it = rows[:, None] == theirs.rows[:, :, None]
    is_same = is_it.any(axis=2).all(axis=1)
    gap = np.where(is_it, r[:, None], 0.0).sum(axis=2) - theirs.responsibilities
    means = np.abs(np.asarray(new.means) - theirs.parameters["means"]).max(axis=1)
    return {
        "neighbours_listed_percent": 100.0 * float(is_same.mean()),
        "responsibility_error": float(np.abs(gap[is_same]).max()),
        "responsibility_error_999": float(np.quantile(np.abs(gap[is_same]).max(axis=1), 0.999)),
        "mean_error_m_999": float(np.quantile(means, 0.999)),
    }


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
    ours = executable(icp, *arguments[0])
    clouds = [
        (_host(jax.tree.map(lambda leaf: leaf[::stride], points)), start.as_matrix()) for points, start, _ in cases
    ]
    surface = _host(target) | {"points": _host(target)["means"]}
    reach, num_steps = 0.1, config.num_searches * config.max_steps

    def open3d_one() -> np.ndarray:
        return baselines.colored_icp(clouds[0][0], surface, np.asarray(clouds[0][1], float), reach, num_steps)

    truth = [case[2] for case in cases]
    mine = [np.asarray(ours.verb(*each)[0].as_matrix(), float) for each in arguments]
    theirs = [
        baselines.colored_icp(cloud, surface, np.asarray(start, float), reach, num_steps) for cloud, start in clouds
    ]
    ours.facts.update(points=len(clouds[0][0]["points"]), gaussians=len(surface["points"]), steps=num_steps)
    ours.facts.update(start_cm=100.0 * offset[0], start_deg=float(np.degrees(offset[1])), views=len(cases))
    ours.facts.update(_pose_errors(mine, truth))
    candidates = {"emgs_jax": ours, "Open3D": Candidate(open3d_one, None, _pose_errors(theirs, truth))}
    return compare(interleaved("icp", candidates, repetitions), "Open3D")


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


def time_render(data: Data, thin: int, num_gaussians: int, repetitions: int) -> list[Timing]:
    """Drawing colours on every `thin`-th pixel against compositing without tiles, and gsplat where it can run.

    Without tiles no more than MAX_PAIRS of a splat and a pixel are looked at, on lines evenly spread over the image:
    every line takes as long as every other, so the time of all is as many times as long.
    """
    gaussians = gaussians_of(data, num_gaussians)
    T, camera = view(data, 0)[0], downscale(data.camera, thin)
    config = data.config.refinement.render
    ours = executable(render, gaussians, gaussians.colors, T, camera, config)
    splats = project_gaussians(gaussians, T, camera, config.covariance_scale, config.blur)
    colors = np.asarray(gaussians.colors)[np.asarray(splats.valid)]
    num_lines = min(max(MAX_PAIRS // (num_gaussians * camera.width), 1), camera.height)
    lines = np.linspace(0, camera.height - 1, num_lines).astype(int).tolist()
    dense = (_host(splats), colors, camera.width, lines, config)
    drawn = ours.call()
    ours.facts.update(gaussians=num_gaussians, pixels=camera.width * camera.height, tile_overflow=int(drawn.overflow))
    ours.facts["color_error_999"] = color_error(np.asarray(drawn.values)[lines], baselines.render(*dense))
    candidates = {"emgs_jax": ours}
    candidates["NumPy"] = Candidate(lambda: baselines.render(*dense), None, {"drawn_lines": num_lines})
    candidates |= _torch_candidates(gaussians, T, camera, dense)
    if "gsplat" not in candidates:
        ours.facts["gsplat"] = "no row: it needs the package, PyTorch and a CUDA GPU"
    timings = interleaved("render", candidates, repetitions)
    return compare([of_all_lines(timing, camera.height) for timing in timings], "NumPy")


def color_error(image: np.ndarray, other: np.ndarray) -> float:
    """Return the difference that one of a thousand values exceeds: a pixel at the rim of a splat may be in or out."""
    return float(np.quantile(np.abs(image - other), 0.999))


def of_all_lines(timing: Timing, height: int) -> Timing:
    """With the time that all lines would take, where only some are drawn."""
    share = timing.facts.get("drawn_lines", height) / height
    return replace(timing, seconds=[seconds / share for seconds in timing.seconds])


def _torch_candidates(gaussians: Gaussians, T: jaxlie.SE3, camera: Any, dense: tuple) -> Mapping[str, Candidate]:
    """The same in PyTorch, and gsplat on a CUDA GPU, where these packages are installed."""
    if importlib.util.find_spec("torch") is None:
        return {}
    import torch

    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    tensor = lambda value: torch.as_tensor(np.array(value), device=device)  # noqa: E731
    synchronize = torch.cuda.synchronize if device.type == "cuda" else lambda: None
    arrays, colors, width, lines, config = dense
    tensors = {name: tensor(value) for name, value in arrays.items()}

    def dense_torch() -> None:
        with torch.device(device):
            baselines.render(tensors, tensor(colors), width, lines, config, torch)
        synchronize()

    found = {f"PyTorch, {device.type}": Candidate(dense_torch, None, {"drawn_lines": len(lines)})}
    if device.type == "cuda" and importlib.util.find_spec("gsplat") is not None:
        variances, axes = np.linalg.eigh(np.asarray(gaussians.covs) * float(config.covariance_scale))
        axes *= np.sign(np.linalg.det(axes))[:, None, None]
        quaternions = jax.vmap(jaxlie.SO3.from_matrix)(jnp.asarray(axes)).wxyz
        opacities = np.full(len(variances), float(config.opacity), np.float32)
        model = [tensor(x) for x in (gaussians.means, quaternions, np.sqrt(variances), opacities)]
        intrinsics = np.eye(3, dtype=np.float32)
        intrinsics[[0, 1], [0, 1]], intrinsics[:2, 2] = np.asarray(camera.focal), np.asarray(camera.center) + 0.5
        pose, rgb = tensor(T.inverse().as_matrix()), tensor(gaussians.colors)

        def splat() -> None:
            baselines.render_gsplat(model, rgb, pose, tensor(intrinsics), (camera.width, camera.height))
            synchronize()

        found["gsplat"] = Candidate(splat)
    return found

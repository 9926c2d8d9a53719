"""In a world of another size, or elsewhere, all of a run comes out the same: from the first window to polished splats.

A thousandth and a thousand are no powers of two, so that inputs are rounded; of noise as of a metre in ten millions a
gate may decide otherwise, which grows from step to step. This noise has no such point.
"""

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jaxlie
import numpy as np
import pycolmap
import pytest
import scene as sc
from loop_scene import (
    keyframe,
    loops_config,
    matrix,
    neighbours_of,
    place_recognition_config,
    room,
    verification_config,
)
from scene import FULL, THINNED, WHOLE
from stereo_scene import structure_config

from emgs_jax.back_end.factors import FrameData, NoiseConfig, loop_factor, map_factor, sequential_factor, stack_factors
from emgs_jax.config import configure
from emgs_jax.config.configure import build
from emgs_jax.data.spool import Spool
from emgs_jax.geometry import Sim3
from emgs_jax.loop_closure.place_recognition import Database, add_keyframe
from emgs_jax.loop_closure.relocalization import PosedKeyframes, relocalize
from emgs_jax.loop_closure.verification import LoopMeasurement, verify
from emgs_jax.polish.fit import Views, fit
from emgs_jax.polish.seeds import Seeds
from emgs_jax.pose_graph.deform import DeformConfig, deform
from emgs_jax.pose_graph.factors import Nodes, PoseGraph
from emgs_jax.pose_graph.optimize import PoseGraphConfig, optimize
from emgs_jax.render.densify import DensifyConfig, densify
from emgs_jax.slam import SlamState, StepInfo, init_state, step
from emgs_jax.structure.model import to_structure

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("small")]
VIEWS, STEPS, SEED = 3, 10, 2
COUNT = VIEWS + STEPS
ELSEWHERE = (0.7, 0.2, -0.4), (600.0, -700.0, 400.0)  # a turn, and a kilometre: float32 has steps of .06 mm there


class World(NamedTuple):
    """How large it is, and how it is turned and moved."""

    size: float
    turn: tuple[float, float, float]
    shift: tuple[float, float, float]

    @property
    def motion(self) -> Sim3:
        T = sc.matrix_of(sc.pose(self.turn))
        return Sim3(self.size, T[:3, :3], np.array(self.shift))

    def pose(self, T: jaxlie.SE3) -> jaxlie.SE3:
        return sc.pose_of(self.motion.apply_to_poses(sc.matrix_of(T)))

    def every(self, poses: jaxlie.SE3) -> jaxlie.SE3:
        return sc.stack_poses([self.pose(jaxlie.SE3(values)) for values in np.asarray(poses.wxyz_xyz)])

    def seen(self, observation):
        """Of a camera, in its frame."""
        return sc.replace(observation, points=self.size * np.asarray(observation.points, float))

    def back(self, poses: np.ndarray) -> np.ndarray:
        """Poses (n, 4, 4) of this world in the usual one."""
        return self.motion.inverse().apply_to_poses(poses)


USUAL = World(1.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def mapped(world: World) -> tuple[SlamState, list[StepInfo]]:
    rng, config = np.random.default_rng(SEED), sc.at(sc.slam_config(*WHOLE), "localization.max_residual", 1.0)
    # The field turns rounding into other pixels at rims; its unit is tested in registration/test_depth_field.py.
    config = sc.at(config, "localization.icp.max_field", 0.0)
    for path in ("fit.min_std", "em.min_std", "splitting.min_std", "submap.voxel_size", "submap.margin"):
        stage, name = path.split(".")
        config = sc.at(config, path, world.size * float(getattr(getattr(config, stage), name)))
    poses = [sc.path_pose(i) for i in range(VIEWS)]
    views = [sc.noisy(sc.observe_room(T, THINNED, num_features=2), THINNED, rng, 0.02) for T in poses]
    views = sc.stack([world.seen(view) for view in views])
    state, _ = init_state(views, world.every(sc.stack_poses(poses)), FULL, config)
    parts, infos = lambda p: (p.current, p.previous, p.T_world_views, p.T_world_anchor), []  # noqa: E731
    for number in range(STEPS):
        prediction = sc.noisy_prediction(VIEWS + number, THINNED, rng)
        current, previous, views, anchor = parts(prediction)
        moved = world.seen(current), world.seen(previous), world.every(views), world.pose(anchor)
        state, info = step(state, eqx.tree_at(parts, prediction, moved), FULL, config)
        infos.append(jax.device_get(info))
    return jax.device_get(state), infos


def paths_of(world: World, infos: list[StepInfo]) -> np.ndarray:
    """Poses of all frames in this world, (n, 4, 4)."""
    first = [world.pose(sc.path_pose(i)) for i in range(VIEWS)]
    return np.stack([sc.matrix_of(T) for T in (*first, *(info.T_world_camera for info in infos))])


def graph_of(world: World, infos: list[StepInfo]) -> PoseGraph:
    """Of the frames, with a loop that knows where the last one is from the first that was placed."""
    poses, s = paths_of(world, infos), world.size
    scales = np.append(np.zeros(VIEWS), np.log([float(info.localization.scale) for info in infos]))
    noise, factors = NoiseConfig(pair=0.18, map=0.5, log_scale=0.08, depth=0.03), []
    for time, info in enumerate(infos, start=VIEWS):
        wall, known = np.full((2, 2, 3), 3.0 * s), {time: np.eye(4), time - 1: np.eye(4)}
        frame = FrameData(time, wall, wall, np.ones((2, 2), bool), known, float(info.localization.depth_noise))
        so_far = poses[: time + 1], scales[: time + 1]
        factors += [sequential_factor(frame, *so_far, lambda _: True, noise)]
        factors += [map_factor(frame, *so_far, int(info.origin), noise)]
    Z = np.linalg.inv(sc.matrix_of(sc.path_pose(VIEWS))) @ sc.matrix_of(sc.path_pose(COUNT - 1))
    Z[:3, 3] *= s * np.exp(-scales[VIEWS])
    weights = np.diag(1.0 / np.array([0.005 * s] * 3 + [0.005] * 3 + [0.02]))
    factors += [loop_factor(LoopMeasurement(VIEWS, COUNT - 1, Z, scales[-1] - scales[VIEWS], weights, 50))]
    T = sc.stack_poses([sc.pose_of(pose) for pose in poses])
    return PoseGraph(Nodes(T, sc.device(scales), sc.device(np.arange(COUNT) >= VIEWS - 1)), stack_factors(factors))


deformed = sc.on_host(lambda *given: deform(*given, DeformConfig(9, 40.0)))
densified = sc.on_host(lambda map, T, config: densify(map.gaussians, T, THINNED, config))


def polished(world: World, map, poses: np.ndarray, folder: Path) -> tuple[list, np.ndarray, list]:
    """Densified views of the map, and splats that begin on them: counts, poses, and numbers without a unit."""
    pytest.importorskip("optax", reason="the extra of emgs polish: pip install -e .[polish]")
    words = "polish.loss.render.tile_size=16", "polish.steps=4", "polish.pixels_per_splat=4"
    settings = build(configure.compose("folder=x", *words, name="polish"), "polish")
    drawing = DensifyConfig(min_std=0.01 * world.size, render=sc.slam_config(*WHOLE).refinement.render, points="map")
    seeds, targets, rng, views = Seeds(THINNED, settings.pixels_per_splat), Spool(), np.random.default_rng(0), []
    for pose in poses:
        views += [densified(map, sc.pose_of(pose), drawing)]
        image = np.float32(rng.uniform(size=(24, 32, 3)))
        seeds.add(views[-1], image, pose)
        targets.append(np.concatenate([image, np.where(views[-1].valid, views[-1].depth, 0.0)[..., None]], -1))
    anchors, colors = seeds.anchors(lambda means, _: np.full(len(means), 0.01 * world.size))
    spreads = np.tile(np.diag([0.01 * world.size] * 3 + [0.01] * 3), (len(poses), 1, 1))
    frames = Views(targets, poses, spreads, np.ones((len(poses), 3)))
    splats, frames = fit(anchors, colors, frames, THINNED, settings, folder / "state.npz")
    depths = [view.depth / world.size for view in views]
    return [len(colors), *(view.valid.sum() for view in views)], frames.poses, [*depths, *jax.tree.leaves(splats)]


@cache
def run(world: World) -> tuple[list, np.ndarray, list]:
    """From a first window to splats: counts, poses in the usual world, and numbers without a unit."""
    (state, infos), s = mapped(world), world.size
    counts = [
        (
            *(i.localization.is_tracked, i.localization.icp.num_inliers, *jax.tree.leaves(i.em)[:3]),
            *(*jax.tree.leaves(i.refinement), i.origin, i.num_gaussians, i.num_left_out),
        )
        for i in infos
    ]
    graph = graph_of(world, infos)
    nodes, info = optimize(graph, PoseGraphConfig(0.2, 16.8, "chordal", 20, 1e-6, 1e-6, np.inf))
    assert not info.reason and info.cost < info.cost_before
    map = deformed(state.map, graph.nodes, nodes, np.float32(0.01 * s))
    moved = np.stack([sc.matrix_of(jaxlie.SE3(values)) for values in np.asarray(nodes.T_world.wxyz_xyz)])
    with tempfile.TemporaryDirectory() as folder:
        of_splats, fitted, numbers = polished(world, map, moved[-2:], Path(folder))
    poses = np.concatenate([paths_of(world, infos), moved, fitted])
    valid, g = map.gaussians.valid, map.gaussians
    sizes = np.sqrt(np.linalg.eigvalsh(np.float64(g.covs[valid])))[:, 1:] / s  # the least is little but rounding
    numbers += [nodes.log_scale, sizes, map.weight[valid], [i.localization.depth_noise for i in infos]]
    numbers += [world.motion.inverse().apply(np.float64(g.means[valid])), [info.cost_before, info.cost]]
    return [counts, of_splats, info.num_iterations], world.back(poses), numbers


@cache
def closed(world: World) -> tuple[list, np.ndarray, list]:
    """A loop, a lost camera and a structure, likewise; each in units of its own inference, poses in float64."""
    s, cameras = world.size, [matrix((0, 2 * side, 0), (side, 0, 0)) for side in (-0.2, 0.0, 0.2)]
    lengths = {"alignment.min_extent": 0.2, "alignment.refine.floor_translation": 0.01, "max_neighbour_distance": 0.015}
    words = (f"{name}={s * length}" for name, length in lengths.items())
    verification = verification_config(*words)
    query = keyframe(room(), matrix((0, 4, 0), (0.25, 0.05, 0.1)), 500, s, 0.005)
    beside = [
        replace(
            one, keyframe=replace(one.keyframe, points=s * one.keyframe.points), log_ratio=one.log_ratio - np.log(s)
        )
        for one in neighbours_of(room(), cameras[1], s)
    ]
    loop, why = verify(query, keyframe(room(), cameras[1], 3, s, 0.005), beside, verification)
    assert loop is not None, why
    appearance, database = place_recognition_config("num_words=8", "suppressed_gap=5"), Database()
    for frame, T in enumerate(cameras):
        database = add_keyframe(database, keyframe(room(), T, frame, s), appearance)
    known = PosedKeyframes(database, world.motion.apply_to_poses(np.stack(cameras)), [0.0] * 3, [True] * 3)
    found, _ = relocalize(query, known, appearance, verification, loops_config()["relocalization"])
    pycolmap.set_random_seed(0)
    few = {"num_rigs": 1, "num_cameras_per_rig": 1, "num_frames_per_rig": 8, "num_points3D": 80}
    model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(**few))
    names = sorted(Path(image.name).stem for image in model.images.values())
    model.transform(pycolmap.Sim3d(s, pycolmap.Rotation3d(world.motion.rotation), world.motion.translation))
    structure = to_structure([model], names, structure_config())
    T = structure.T_world_camera
    loop_pose = np.array(loop.Z_a_b)
    loop_pose[:3, 3] /= s
    poses = [loop_pose, world.back(found.T_world_camera), *np.linalg.inv(T[0]) @ T]
    unit = np.diag([1.0 / s] * 3 + [1.0] * 4)
    numbers = [unit @ np.linalg.inv(loop.sqrt_info), unit @ found.covariance @ unit, structure.covariance]
    counts = [loop.num_inliers, found.keyframe, *map(len, structure.landmarks)]
    return counts, np.stack(poses), [*numbers, [loop.log_ratio, found.log_scale]]


@pytest.mark.parametrize(
    ("part", "size", "turn", "shift"),
    [(part, size, *USUAL[1:]) for part in (run, closed) for size in (1e-3, 1e3)] + [(closed, 1.0, *ELSEWHERE)],
)
def test_in_another_world_counts_are_the_same_and_numbers_but_for_rounding(part, size, turn, shift):
    counts, poses, numbers = part(USUAL)
    others, other_poses, other_numbers = part(World(size, turn, shift))
    assert others == counts
    np.testing.assert_allclose(other_poses, poses, atol=1e-4)
    for one, other in zip(numbers, other_numbers, strict=True):
        one = np.asarray(one)
        np.testing.assert_allclose(other, one, atol=1e-3 * np.nanmax(np.abs(one)))


def test_a_kilometre_away_and_turned_a_run_is_as_good():
    """Its sixteenth of a millimetre decides at gates, so that another path comes out, as far from the true one."""
    (usual, poses, _), (there, other_poses, _) = run(USUAL), run(World(1.0, *ELSEWHERE))
    truth = np.tile([sc.path_pose(i).translation() for i in range(COUNT)], (2, 1))  # as placed, and after the loop
    before, after = (
        np.linalg.norm(x[: 2 * COUNT, :3, 3] - truth, axis=1).reshape(2, COUNT) for x in (poses, other_poses)
    )
    np.testing.assert_allclose(np.sqrt(np.mean(after**2, 1)), np.sqrt(np.mean(before**2, 1)), rtol=0.2)
    (infos, (splats, *covered), _), (others, (other_splats, *other_covered), _) = usual, there
    infos, others = (np.array(one, int) for one in (infos, others))
    assert (infos[:, 0] == 1).all() and (others[:, 0] == 1).all()
    np.testing.assert_allclose(others.sum(0)[[1, 3, 4, 10]], infos.sum(0)[[1, 3, 4, 10]], rtol=0.06)
    np.testing.assert_allclose(other_covered, covered, rtol=0.06)
    assert abs(other_splats - splats) < 0.25 * splats  # some sixty: 51 beside 60 on one processor

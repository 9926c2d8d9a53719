"""Many settings at once; oracle: a run with each of them by itself."""

import jax
import numpy as np
import pytest
from scene import at, first_window, observe_room, path_pose, predict_room, slam_config, stack_poses
from tiny_run import EditedPrior, dataset

from emgs_jax.back_end.state import BackEnd
from emgs_jax.data.base import Frame
from emgs_jax.mapping.atlas import Atlas
from emgs_jax.mapping.batch import integrate_stack, make_stack, map_together, programs, unstacked
from emgs_jax.mapping.pipeline import map_input
from emgs_jax.mapping.run import MappingRun
from emgs_jax.mapping.window_input import RawView, WindowInput
from emgs_jax.ops.pytree import stack

pytestmark = pytest.mark.xdist_group("small")

WHOLE = ("slam.localization.coarse=same_image", "slam.initialization=merged")
FRAME = 3


def shown(index: int) -> tuple[Frame, RawView]:
    image = np.zeros((24, 32, 3), np.uint8)
    return Frame(index, float(index), str(index), image), RawView(
        image, image[..., 0] > 0, image, np.eye(4), np.zeros((1, 1, 0))
    )


@pytest.fixture(scope="module")
def sequence(camera):
    poses = [path_pose(i) for i in range(FRAME)]
    views = stack([observe_room(T, camera, num_features=2) for T in poses])
    steps = [predict_room(FRAME + i, camera, has_newest=i < 1, num_features=2) for i in range(2)]
    first = WindowInput(
        *zip(*map(shown, range(FRAME)), strict=True), first_window(views, stack_poses(poses)), np.eye(4), {}, {}
    )
    return [
        first,
        *(
            WindowInput(*((part,) for part in shown(FRAME + i)), step, np.eye(4), {}, {})
            for i, step in enumerate(steps)
        ),
    ]


def assert_close(a, b):
    """vmap adds in another order: sums over some hundred points, so some hundred roundings of the largest value.

    One Gaussian in fifty may have gained or lost a point that lies at the edge of a gate.
    """
    a, b = np.asarray(a), np.asarray(b)
    if a.dtype.kind != "f":
        np.testing.assert_array_equal(a, b)
    elif a.size:
        atol = 256 * np.finfo(np.float32).eps * np.abs(b).max()
        differs = ~np.isclose(a, b, rtol=0, atol=atol).reshape(len(a), -1).all(axis=1)
        assert differs.mean() <= 0.02 and np.abs(a - b).max() < 0.05 * np.abs(b).max(), np.flatnonzero(differs)


def runs_of(camera, configs) -> list[MappingRun]:
    return [MappingRun(Atlas(camera, config, BackEnd(None, (1.0, 1.0, 0.0, 0.0), 0.0))) for config in configs]


@pytest.mark.weekly
def test_every_setting_of_a_stack_is_what_a_run_with_it_gives_and_all_grow_when_one_is_full(sequence, camera):
    configs, roomy = (
        [at(at(base, "em.max_mahalanobis_sq", x), "refinement.max_mahalanobis_sq_2d", x) for x in (0.0, 4.6, 20.0)]
        for base in (
            slam_config(*WHOLE, f"slam.submap.map_capacity={size}", "slam.submap.submap_capacity=256")
            for size in (128, 512)
        )
    )
    together, alone = (runs_of(camera, some) for some in (configs, roomy))
    stacked = make_stack(together)
    for given in sequence:
        stacked = integrate_stack(stacked, given)
        alone = [map_input(run, given)[0] for run in alone]
    for mine, run in zip(unstacked(stacked), alone, strict=True):
        count = int(run.map.gaussians.valid.sum())
        assert int(mine.map.gaussians.valid.sum()) == count and mine.map.weight.shape == (512,)
        for a, b in zip(jax.tree.leaves(mine.map), jax.tree.leaves(run.map), strict=True):
            assert_close(a[:count], b[:count])
        np.testing.assert_allclose(mine.poses, run.poses, atol=1e-5)  # m; roundings of the steps before
        assert [record.fused for record in mine.records] == [record.fused for record in run.records]
        assert [record.index for record in mine.records] == list(range(FRAME + 2))
    for step in range(FRAME, FRAME + 2):
        assert len({run.records[step].fused for run in alone}) == 3  # the settings do something


def test_configs_share_a_program_where_only_traced_leaves_differ(camera):
    base = slam_config()
    configs = [base, at(base, "em.noise", 0.5), slam_config("slam.em.num_neighbours=4"), at(base, "fit.min_std", 0.02)]
    configs.append(at(base, "observation.min_confidence", 2.0))
    assert programs(configs) == [[0, 1, 3], [2], [4]]
    with pytest.raises(ValueError, match="programs"):
        next(map_together(runs_of(camera, configs), dataset(), EditedPrior()))

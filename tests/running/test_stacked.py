"""Many settings at once; oracle: `slam.run` with each of them by itself."""

import jax
import numpy as np
import pytest
from scene import at, observe_room, path_pose, predict_room, slam_config, stack_poses

from emgs_jax.ops.pytree import stack
from emgs_jax.running.stacked import map_configs, programs
from emgs_jax.slam import FirstWindow, run

WHOLE = ("slam.localization.coarse=same_image", "slam.initialization=merged")
FRAME = 3


@pytest.fixture(scope="module")
def sequence(camera):
    poses = [path_pose(i) for i in range(FRAME)]
    views = stack([observe_room(T, camera, num_features=2) for T in poses])
    steps = [predict_room(FRAME + i, camera, has_newest=i < 1, num_features=2) for i in range(2)]
    return [FirstWindow(views, stack_poses(poses)), *steps]


def assert_close(a, b):
    """vmap adds in another order: sums over some hundred points, so some hundred roundings of the largest value."""
    a, b = np.asarray(a), np.asarray(b)
    if a.dtype.kind != "f":
        np.testing.assert_array_equal(a, b)
    elif a.size:
        np.testing.assert_allclose(a, b, rtol=0, atol=256 * np.finfo(np.float32).eps * np.abs(b).max())


@pytest.mark.slow
def test_every_setting_of_a_stack_is_what_a_run_with_it_gives_and_all_grow_when_one_is_full(sequence, camera):
    configs, roomy = (
        [at(at(base, "em.max_mahalanobis_sq", x), "refinement.max_mahalanobis_sq_2d", x) for x in (0.0, 4.6, 20.0)]
        for base in (
            slam_config(*WHOLE, f"slam.submap.map_capacity={size}", "slam.submap.submap_capacity=256")
            for size in (128, 512)
        )
    )
    infos, alone = [], []
    states = map_configs(sequence, camera, configs, lambda _, info: infos.append(info))
    for i, config in enumerate(roomy):
        state = run(sequence, camera, config, lambda _, info: alone.append(info))
        count, mine = int(state.map.gaussians.valid.sum()), jax.tree.map(lambda leaf, i=i: leaf[i], states)
        assert int(mine.map.gaussians.valid.sum()) == count
        for a, b in zip(jax.tree.leaves(mine.map), jax.tree.leaves(state.map), strict=True):
            assert_close(a[:count], b[:count])
        assert_close(mine.T_world_previous.wxyz_xyz, state.T_world_previous.wxyz_xyz)
    assert states.map.weight.shape == (3, 512)
    for step in range(2):
        fused = [int(alone[2 * i + step].em.num_fused) for i in range(3)]
        assert infos[step].em.num_fused.tolist() == fused and len(set(fused)) == 3


def test_configs_share_a_program_where_only_traced_leaves_differ(sequence, camera):
    base = slam_config()
    configs = [base, at(base, "em.noise", 0.5), slam_config("slam.em.num_neighbours=4"), at(base, "fit.min_std", 0.02)]
    configs.append(at(base, "observation.min_confidence", 2.0))
    assert programs(configs) == [[0, 1, 3], [2], [4]]
    with pytest.raises(ValueError, match="programs"):
        map_configs(sequence, camera, configs)

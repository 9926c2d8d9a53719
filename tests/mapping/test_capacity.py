"""What is compiled when: all of a step before the first, and of a larger map only the look-up and the insertion.

The first of a group: what is compiled here test_slam.py finds in memory.
"""

from dataclasses import replace

import jax
import pytest
from listening import compiled
from scene import FULL, WHOLE, first_window, observe_room, path_pose, predict_room, slam_config, stack_poses

from emgs_jax.gaussian_map import grow
from emgs_jax.mapping.capacity import advance, prepare_step, start
from emgs_jax.ops.pytree import stack

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("small")]  # the whole step is compiled


@pytest.fixture(scope="module")
def prepared(camera):
    """A map and its config after `prepare_step`, and what `prepare_step` compiled."""
    config = slam_config(*WHOLE)
    poses = [path_pose(i) for i in range(3)]
    first = first_window(stack([observe_room(T, camera, num_features=2) for T in poses]), stack_poses(poses))
    jax.clear_caches()
    with compiled() as names:
        prepare_step(first.views, FULL, config)
    return *start(first, FULL, config), names


def test_a_step_after_its_preparation_compiles_nothing(prepared, camera):
    state, config, names = prepared
    # Not `cluster`, which first maps of other files may have asked for.
    assert {"_localize_coarse", "_select", "_localize_fine", "_fuse", "_refine", "_store"} <= set(names)
    given = predict_room(3, camera, num_features=2), FULL, config
    with compiled() as more:
        advance(state, *given)
    assert not more


def test_a_larger_map_compiles_the_look_up_and_the_insertion_and_nothing_of_the_work_on_the_submap(prepared, camera):
    state, config, _ = prepared
    state, _, config = advance(state, predict_room(3, camera, num_features=2), FULL, config)
    larger = grow(state.map, 2 * config.submap.map_capacity)
    state = replace(state, map=larger)
    with compiled() as names:
        advance(state, predict_room(4, camera, num_features=2), FULL, config)
    assert set(names) == {"_select", "_store"}

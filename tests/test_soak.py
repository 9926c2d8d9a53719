"""Hard scenes, short: whatever a camera sees, the map stays sound and every frame has a status."""

from types import SimpleNamespace

import equinox as eqx
import numpy as np
import pytest

from emgs_jax.mapping.records import FrameRecord
from tests.hand_run import hand_run, poses_along
from tools.soak.scenes import NUM_FRAMES, SCENES, ToAndFro, to_and_fro
from tools.soak.soak import faults, grown, ratio, soak

pytestmark = pytest.mark.xdist_group("tiny")

SHORT = 14
USUAL = "black frames"


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [USUAL, *(pytest.param(name, marks=pytest.mark.weekly) for name in SCENES if name != USUAL)]
)
def test_no_scene_poisons_the_map_and_every_frame_has_a_status(name):
    run, curves = soak(ToAndFro(SHORT, *SCENES[name]))
    assert faults(run, SHORT) == []
    assert len(curves.memory_mb) == len(curves.seconds) == len(curves.num_gaussians) == SHORT
    if name in ("static", "exposure jump"):
        assert "tracked" in curves.status[-3:], "what is easy is tracked"
    if name == "black frames":
        assert set(curves.status[5:8]) == {"degraded"}, "where nothing is seen nothing is fused"
        assert curves.num_gaussians[7] == curves.num_gaussians[4]


def test_the_walk_is_to_and_fro():
    assert [to_and_fro(i) for i in (0, 1, 38, 39, 40, 77, 78, 79)] == [0, 1, 38, 39, 38, 1, 0, 1]
    places = [to_and_fro(i) for i in range(500)]
    for change, place in SCENES.values():
        assert len([ToAndFro(30, change, place)[i] for i in range(30)]) == 30
    assert max(places) == NUM_FRAMES - 1 and set(np.abs(np.diff(places))) == {1}


def test_what_is_poisoned_is_a_fault():
    run = hand_run(*[poses_along(np.zeros(6))] * 3)
    run.records = [
        FrameRecord(record.index, None, 0.0, record.status, reason="why", pose=np.eye(4)) for record in run.records
    ]
    run = SimpleNamespace(map=run.state.map, records=run.records, poses=np.stack([r.pose for r in run.records]))
    assert faults(run, 6) == []
    assert faults(run, 7) == ["6 records of 7 frames"]
    run.poses = run.poses * np.nan
    run.records[2] = FrameRecord(2, None, 0.0, "degraded")
    gaussians = run.map.gaussians
    means = np.array(gaussians.means)
    means[int(np.argmax(np.asarray(gaussians.valid)))] = np.nan
    run.map = eqx.tree_at(lambda map: map.gaussians.means, run.map, means)
    found = faults(run, 6)
    assert len(found) == 3 and ".means has values" in found[0]
    assert found[1:] == ["frame 2 has no reason", "a pose is not finite"]


def test_growth_is_the_last_tenth_over_the_second():
    assert ratio([9.0] * 10 + [2.0] * 10 + [5.0] * 70 + [3.0] * 10) == 1.5
    ratios = {"memory": 1.06, "step": 1.05}
    assert grown(ratios, 1.05) == ["memory grew to 1.060 times, 1.05 is allowed"]

"""view=live: what is served follows a run (made by hand, so it is known), and the run neither waits nor ends for it."""

import threading
from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from hand_run import poses_along, wall
from test_viewer import free_port
from tiny_run import compose

from emgs_jax.config.configure import build
from emgs_jax.data.base import Rates
from emgs_jax.gaussian_map import new_map
from emgs_jax.mapping.records import FrameRecord
from emgs_jax.ops.camera import Camera
from emgs_jax.viewer import live
from emgs_jax.viewer.live import LiveConfig, live_view

pytestmark = pytest.mark.slow


NUM_FRAMES = 4
PRIOR = SimpleNamespace(feature_names=("left", "right"), text_features=np.eye(2))


class GrowingRun:
    """A wall that is a metre longer after each frame; the camera goes along it."""

    def __init__(self) -> None:
        self.camera, self.records, self.map = Camera((24.0, 24.0), (11.5, 7.5), 24, 16), (), None

    def views(self):
        for row, pose in enumerate(poses_along(np.arange(NUM_FRAMES))):
            record = FrameRecord(row, f"{row}.png", row / 4, "tracked", pose=pose, residual=0.0123456)
            self.records = (*self.records, record)
            gaussians = wall(0.0, row + 1.0)
            self.map = new_map(gaussians, jnp.ones(gaussians.valid.shape[0]), jnp.ones(()), jnp.asarray(0))
            yield SimpleNamespace(image=np.full((16, 24, 3), 10 * row, np.uint8))
        poses = poses_along(2.0 * np.arange(NUM_FRAMES))  # another unit at the end, as `in_own_unit` does
        self.records = [replace(record, pose=pose) for record, pose in zip(self.records, poses, strict=True)]


@pytest.fixture
def at_once(monkeypatch):
    """A run is drawn however long that takes."""
    monkeypatch.setattr(live, "SHARE", np.inf)


def served(run, config, kept=range(NUM_FRAMES)):
    pytest.importorskip("viser", reason="the viewer's extra: pip install -e .[viewer]")
    return live_view(config, run, build(compose(), "densify").render, PRIOR, [*kept])


def test_what_is_served_follows_the_run_and_at_its_end_is_the_whole_of_it(at_once):
    run, counts = GrowingRun(), []
    with served(run, LiveConfig(free_port(), 0.0), kept=[0, 2, 4, 6]) as view:
        assert view.viewer.server.get_host() == "127.0.0.1" and "No frame" in view.viewer.facts.content
        view.viewer.words.value = "left"  # asked before there is a map
        for seen in run.views():
            view.show(run, seen.image)
            view.wait()
            counts.append((len(view.viewer.layers["mean"]), len(view.viewer.scene.splats.centers)))
            assert view.viewer.frame.value == len(run.records) - 1, "who looks at the last frame goes on to do so"
            np.testing.assert_array_equal(view.viewer.picture.image, seen.image)
        view.show_last(run)
        viewer = view.viewer
        assert counts == [(200 * n, 200 * n) for n in range(1, NUM_FRAMES + 1)]
        assert "Gaussians: left" in viewer.answer.content, "words stay asked"
        np.testing.assert_array_equal(viewer.scene.chosen.position, [2.0 * (NUM_FRAMES - 1), 0, 0])
        assert viewer.scene.paths[0].points.shape == (NUM_FRAMES - 1, 2, 3) and viewer.scene.paths[1] is None
        assert "frame 6: tracked, residual 1.2 % of the depth" in viewer.facts.content, "its number in the data set"


def test_how_a_camera_is_mapped_is_shown_beside_the_map(at_once):
    run = GrowingRun()
    with served(run, LiveConfig(free_port(), 0.0)) as view:
        for row, seen in enumerate(run.views()):
            if row == 1:
                run.records = (*run.records[:-1], replace(run.records[-1], status="lost"))
            view.show(run, seen.image, Rates(2.84, 30 * row, 0.41))
            view.wait()
            lost = int(row > 0)
            words = f"{row + 1} frames, {lost} lost, 2.8 maps/s, {30 * row} dropped, 0.4 s behind"
            assert words in view.viewer.progress.content
        view.show(run, seen.image)
        view.wait()
        assert "dropped" not in view.viewer.progress.content, "where images do not pass"


def test_who_looks_at_an_earlier_frame_is_left_there(at_once):
    run = GrowingRun()
    with served(run, LiveConfig(free_port(), 0.0)) as view:
        for row, seen in enumerate(run.views()):
            view.show(run, seen.image)
            view.wait()
            if row == 2:
                view.viewer.frame.value = 1
        view.show_last(run)
        assert view.viewer.frame.value == 1 and "frame 1:" in view.viewer.facts.content


def test_a_run_is_not_drawn_more_often_than_asked():
    run, drawn = GrowingRun(), []
    with served(run, LiveConfig(free_port(), 3600.0)) as view:
        view.viewer.update = lambda shown: drawn.append(len(shown.frames))
        for seen in run.views():
            view.show(run, seen.image)
            view.wait()
        view.show_last(run)
    assert drawn == [1, NUM_FRAMES]


def test_the_run_does_not_wait_for_what_is_drawn():
    run, drawn, may_end = GrowingRun(), [], threading.Event()
    with served(run, LiveConfig(free_port(), 0.1)) as view:

        def slow(shown):
            may_end.wait(60)
            drawn.append(len(shown.frames))

        view.viewer.update = slow
        for seen in run.views():
            view.show(run, seen.image)
        may_end.set()  # all frames have passed, and the first picture is still being drawn
        view.show_last(run)
    assert drawn == [1, NUM_FRAMES], "the first, and the whole run at its end"


def test_a_view_that_fails_is_said_and_ends_no_run(capsys):
    run = GrowingRun()
    with served(run, LiveConfig(free_port(), 0.0)) as view:

        def broken(shown):
            raise RuntimeError("no more memory")

        view.viewer.update = broken
        for seen in run.views():
            view.show(run, seen.image)
        view.show_last(run)
    assert capsys.readouterr().out.count("the run goes on: RuntimeError('no more memory')") == 1


def test_without_a_config_nothing_is_served():
    with live_view(None, GrowingRun(), None, PRIOR, []) as view:
        assert view is None

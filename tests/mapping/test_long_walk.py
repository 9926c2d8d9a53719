"""A camera that walks to and fro in a room: memory and step time do not grow, and no hard scene poisons the map."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
from tiny_run import compose

from emgs_jax.config.configure import build
from emgs_jax.data.base import Dataset, Frame
from emgs_jax.data.synthetic import Synthetic
from emgs_jax.device.clock import Clock
from emgs_jax.mapping.pipeline import finish_run, map_frames
from emgs_jax.mapping.records import FrameRecord
from emgs_jax.mapping.run import MappingRun, new_run
from emgs_jax.prior.simulated.prior import Simulated
from emgs_jax.runs.metrics import STATUSES

SIZE, PATH, SHORT, LONG = (64, 48), 40, 14, 1500
# The map has room for the whole walk: where it is full it grows once, and another step is compiled.
CAPACITY = "slam.submap.map_capacity=4096", "slam.submap.submap_capacity=4096"


@cache
def room() -> tuple[Synthetic, list[Frame]]:
    found = Synthetic(size=SIZE, num_frames=PATH)
    return found, [found[index] for index in range(PATH)]


def to_and_fro(index: int) -> int:
    """0, 1, …, 39, 38, …, 1, 0, 1, …"""
    lap = 2 * (PATH - 1)
    return min(index % lap, lap - index % lap)


class ToAndFro(Dataset):
    """A data set of so many frames, each from a place on the path of the room and changed by a scene."""

    name, has_ground_truth, files = "to_and_fro", True, lambda self, index: ()

    def __init__(self, num_frames: int, change: Callable = lambda frame: frame, place: Callable = to_and_fro) -> None:
        self.sequence, self.size, self.classes = room()[0].sequence, SIZE, room()[0].classes
        self.intrinsics, self.calibration = room()[0].intrinsics, room()[0].calibration
        self._num_frames, self._change, self._place = num_frames, change, place

    def __len__(self) -> int:
        return self._num_frames

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < self._num_frames:
            raise IndexError(index)
        frame = room()[1][self._place(index)]
        return self._change(replace(frame, index=index, timestamp=float(index), name=f"frame {index}"))

    def pose(self, index: int) -> np.ndarray:
        return room()[1][self._place(index)].T_world_camera

    def fingerprint(self) -> str:
        return f"{self.name} {self._num_frames}"


def between(first: int, past: float, change: Callable[[Frame], Frame]) -> Callable[[Frame], Frame]:
    return lambda frame: change(frame) if first <= frame.index < past else frame


def blurred(frame: Frame) -> Frame:
    """The camera turns by a fifth of the image while the shutter is open; the depth is smeared, too."""
    kernel = np.full((1, SIZE[0] // 5), 5.0 / SIZE[0])
    return replace(frame, image=cv2.filter2D(frame.image, -1, kernel), depth=cv2.filter2D(frame.depth, -1, kernel))


def with_something_that_moves(frame: Frame) -> Frame:
    """A board of a quarter of the image crosses it .7 m before the camera."""
    image, depth = frame.image.copy(), frame.depth.copy()
    start = 2 * frame.index % SIZE[0]
    image[12:36, start : start + 32], depth[12:36, start : start + 32] = (200, 30, 30), 0.7
    return replace(frame, image=image, depth=depth)


def nothing(frame: Frame) -> Frame:
    return replace(frame, image=np.zeros_like(frame.image), depth=np.zeros_like(frame.depth))


SCENES = {  # the change of a frame, and its place on the path
    "black frames": (between(5, 8, nothing), to_and_fro),
    "static": (lambda frame: frame, lambda index: 0),
    "textureless": (lambda frame: replace(frame, image=np.full_like(frame.image, 127)), to_and_fro),
    "motion blur": (between(5, 9, blurred), to_and_fro),
    "moving object": (with_something_that_moves, to_and_fro),
    "exposure jump": (between(5, np.inf, lambda f: replace(f, image=(f.image * 0.25).astype(np.uint8))), to_and_fro),
    "zero overlap": (lambda frame: frame, lambda index: to_and_fro(index if index < 6 else index + 20)),
}


def walked(dataset: ToAndFro, *overrides: str) -> tuple[MappingRun, list[FrameRecord], list[float]]:
    """The run, its records as they came, and MiB of this process after each."""
    records, memory = [], []
    with Clock().watching() as clock:
        start = new_run(dataset, build(compose(*overrides), "slam"), clock)
        for found in map_frames(start, dataset, Simulated(seed=0, classes=dataset.classes)):
            records += (new := found[1])
            memory += [int(Path("/proc/self/statm").read_text().split()[1]) / 256] * len(new)
    return finish_run(found[0]), records, memory


def check_sound(run: MappingRun, num_frames: int) -> None:
    """Whatever was seen: finite Gaussians and poses, and a status of every frame, with its reason."""
    gaussians = jax.device_get(run.map.gaussians)
    assert gaussians.valid.any() and np.linalg.eigvalsh(gaussians.covs[gaussians.valid]).min() > 0
    for leaf in jax.tree.leaves(gaussians):
        assert np.isfinite(leaf[gaussians.valid]).all()
    assert [record.index for record in run.records] == list(range(num_frames)) and np.isfinite(run.poses).all()
    assert all(r.status in STATUSES and (r.reason or r.status not in STATUSES[1:3]) for r in run.records)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["black frames", *(pytest.param(n, marks=pytest.mark.weekly) for n in [*SCENES][1:])])
def test_no_scene_poisons_the_map_and_every_frame_has_a_status(name):
    run, records, _ = walked(ToAndFro(SHORT, *SCENES[name]))
    check_sound(run, SHORT)
    status, num_gaussians = [r.status for r in records], [r.num_gaussians for r in records]
    if name in ("static", "exposure jump"):
        assert "tracked" in status[-3:], "what is easy is tracked"
    if name == "black frames":
        assert {*status[5:8]} == {"degraded"} and num_gaussians[7] == num_gaussians[4], "nothing is fused"


@pytest.mark.weekly
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux to tell its memory")
def test_memory_and_step_time_of_a_long_walk_do_not_grow():
    """The last tenth over the second: before that, programs are compiled and arrays grow."""
    run, records, memory = walked(ToAndFro(LONG), *CAPACITY)
    check_sound(run, LONG)
    seconds = [record.seconds - record.compile_seconds for record in records]
    tenth = LONG // 10
    for values, most in ((memory, 1.05), (seconds, 1.2)):
        assert np.median(values[-tenth:]) < most * np.median(values[tenth : 2 * tenth])

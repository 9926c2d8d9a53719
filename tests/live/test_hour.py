"""An hour of a camera that stays in four rooms, simulated: its memory after ten minutes and at the end.

`HOUR_FRAMES=1500` takes fewer than 10,800 frames, to see that the test works.
"""

import itertools
import os
import time
from pathlib import Path

import pytest
from tiny_run import TINY

import experiments.run
from emgs_jax.config import configure
from emgs_jax.data.apartment import Apartment
from emgs_jax.live import capture
from emgs_jax.live.newest import Shot

FPS, SIZE, COMPILED = 3, (64, 48), 1000  # frames until which programs are compiled, measured
HOUR = int(os.environ.get("HOUR_FRAMES", 10_800))
TEN_MINUTES = max(HOUR // 6, COMPILED)
CAPACITY = "slam.submap.map_capacity=8192", "slam.submap.submap_capacity=1024"


@pytest.mark.weekly
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux to tell its memory")
def test_the_memory_of_an_hour_is_that_of_ten_minutes(tmp_path, monkeypatch):
    rooms, memory, original = Apartment(size=SIZE), [], experiments.run.map_frames
    seen = [
        (frame.image, {"depth": frame.depth, "T_world_camera": frame.T_world_camera})
        for frame in map(rooms.__getitem__, range(len(rooms)))
    ]

    def to_and_fro(source, into):
        """The next image when the last one has been taken: nothing is dropped."""
        for row, (image, given) in enumerate(itertools.cycle([*seen, *seen[-2:0:-1]])):
            while into._shot is not None:
                time.sleep(0.002)
            yield Shot(row / FPS, image, given)

    def watched(*words):
        for found in original(*words):
            memory.extend([int(Path("/proc/self/statm").read_text().split()[1]) / 256] * len(found[1]))
            if len(memory) % 1000 == 0:
                print(f"{max(memory):.0f} MiB after {len(memory)} frames", flush=True)
            yield found

    monkeypatch.setattr(capture, "open_source", to_and_fro)
    monkeypatch.setattr(experiments.run, "map_frames", watched)
    camera = "dataset=camera", "dataset.source=7", f"dataset.max_frames={HOUR}", "dataset.size=[64,48]"
    intrinsics = "dataset.intrinsics=[{},{},{},{}]".format(*rooms.intrinsics)
    of_room = [word for word in TINY if not word.startswith(("dataset.", "slam.submap.", "slam.window_size"))]
    words = *of_room, *CAPACITY, *camera, intrinsics, "prior=stream"
    metrics = experiments.run.run(configure.compose(*words), tmp_path)
    print(f"{max(memory[:TEN_MINUTES]):.0f} MiB after {TEN_MINUTES} frames, {max(memory):.0f} after {HOUR}")
    assert len(memory) == HOUR and max(memory) <= 1.2 * max(memory[:TEN_MINUTES])
    assert metrics["frames/tracked"] > 0.95 * HOUR and metrics["camera/num_dropped"] == 0

"""Show a run in the browser while it maps: its progress every few seconds, drawn by a separate thread.

A step makes new arrays and leaves the old ones unchanged, so the thread can read those of the last step meanwhile. The
run never waits for drawing.
"""

import contextlib
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from tqdm import tqdm

from emgs_jax.data.base import Rates
from emgs_jax.drawing.layers import map_layers
from emgs_jax.features.text import TextEmbeddings
from emgs_jax.gaussian_map import GaussianMap
from emgs_jax.mapping.records import UNPLACED, FrameRecord
from emgs_jax.mapping.run import MappingRun
from emgs_jax.ops.ranges import number
from emgs_jax.prior.base import Prior
from emgs_jax.render.composite import RenderConfig
from emgs_jax.runs.moving import with_moving
from emgs_jax.viewer.scene import Shown
from emgs_jax.viewer.viewer import Viewer

SHARE = 0.05  # largest share of time in which the thread draws
IMAGE_WIDTH = 320  # pixels


@dataclass(frozen=True)
class LiveConfig:
    """Settings of the live view."""

    port: int = number(low=1, high=65535)  # on 127.0.0.1
    every_s: float = number(low=0.1, high=3600)  # least seconds between two pictures


class LiveView:
    """A run that is watched until `stop`; ValueError if the port is taken, or viser is not installed.

    Args:
        text: classes that features are compared with; None without.
        kept: index in the data set of each frame in use.
    """

    def __init__(self, config: LiveConfig, start: Shown, text: TextEmbeddings | None, kept: Sequence[int]) -> None:
        self.viewer, self._every_s = Viewer(start, config.port), config.every_s
        self._start, self._text, self._kept = start, text, kept
        self._thread, self._due = ThreadPoolExecutor(1, "live view"), 0.0
        self._drawing, self._has_failed = self._thread.submit(int), False
        self._image: np.ndarray | None = None  # of the last frame
        self._rates: Rates | None = None

    def show(self, run: MappingRun, image: np.ndarray, rates: Rates | None = None) -> None:
        """Show a run with the image of its last frame, if that is due and nothing is being drawn."""
        self._image, self._rates = image, rates
        if time.monotonic() >= self._due and self._drawing.done():
            self._begin(run)

    def show_last(self, run: MappingRun) -> None:
        """Show a finished run, and wait until it is drawn."""
        self.wait()
        if self._image is not None:
            self._begin(run)
            self.wait()

    def wait(self) -> None:
        """Wait until nothing is being drawn."""
        self._drawing.result()

    def stop(self) -> None:
        """End the server."""
        self._thread.shutdown()
        self.viewer.stop()

    def _begin(self, run: MappingRun) -> None:
        if run.map is not None and not self._has_failed:
            self._drawing = self._thread.submit(self._draw, run.map, run.records, self._image, self._rates)

    def _draw(self, map: GaussianMap, records: Sequence[FrameRecord], image: np.ndarray, rates: Rates | None) -> None:
        """Draw; on failure, print it once, and the run continues without the live view."""
        begin, step = time.monotonic(), -(-image.shape[1] // IMAGE_WIDTH)
        try:
            shown = replace(
                self._start,
                layers=map_layers(map, self._text),
                frames=[vars(record) | {"index": self._kept[record.index]} for record in records],
                poses=np.stack([record.pose for record in records]),
                truth=np.full((len(records), 3), np.nan),
                image=with_moving(np.ascontiguousarray(image[::step, ::step]), vars(records[-1])),
                progress=progress_words(records, rates),
            )
            self.viewer.update(shown)
        except Exception as error:  # whatever it is
            self._has_failed = True
            tqdm.write(f"the live view stays as it is, and the run goes on: {error!r}")
        end = time.monotonic()
        self._due = end + max(self._every_s, (end - begin) / SHARE)


def progress_words(records: Sequence[FrameRecord], rates: Rates | None) -> str:
    """Say how many frames are mapped and lost and, of a camera, how fast."""
    lost = sum(record.status in UNPLACED for record in records)
    return f"{len(records)} frames, {lost} lost" + (f", {rates}" if rates else "")


@contextlib.contextmanager
def live_view(
    config: LiveConfig | None, run: MappingRun, render: RenderConfig, prior: Prior, kept: Sequence[int]
) -> Iterator[LiveView | None]:
    """Serve a run during the block, and print the address; without a config, serve nothing and return None."""
    if config is None:
        yield None
        return
    names, text = tuple(prior.feature_names), None
    if names:
        text = TextEmbeddings(names, np.asarray(prior.text_features, np.float32), (), {})
    start = Shown({}, names, [], np.zeros((0, 4, 4)), np.zeros((0, 3)), run.camera, render)
    live = LiveView(config, start, text, kept)
    try:
        tqdm.write(f"{live.viewer.address} shows the run to this machine while it maps; it ends with the run")
        yield live
    finally:
        live.stop()

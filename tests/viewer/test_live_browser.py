"""view=live with a browser that is connected while the run maps; oracles: the run unwatched, the kernel's sockets."""

import io
import re
import time
from itertools import chain, cycle
from pathlib import Path

import numpy as np
import pytest
from browser import MISSING
from PIL import Image
from test_viewer import free_port
from tiny_run import NUM_FRAMES, TINY, compose, dataset

import experiments.run
from emgs_jax.config import configure
from emgs_jax.live import capture
from emgs_jax.live.newest import Shot, end_all
from emgs_jax.mapping.pipeline import map_frames
from emgs_jax.viewer import live

pytestmark = pytest.mark.xdist_group("tiny")

LISTENS = "0A"  # in /proc/net/tcp
LOOPBACK = "0100007F"  # 127.0.0.1 there


def share_of_the_map(page) -> float:
    """Of the page beside the panel and below viser's notice: what is not as white as where nothing is.

    None yet where the browser, which draws in software, had no time for a picture.
    """
    try:
        picture = page.screenshot()
    except RuntimeError:
        return 0.0
    image = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"))[200:, :880]
    return float((image.min(-1) < 240).mean())


def listening() -> list[tuple[str, int]]:
    """Address, as the kernel writes it, and port of all sockets at which this process takes connections."""
    own = {path.readlink().name for path in Path("/proc/self/fd").iterdir() if path.is_symlink()}
    lines = chain.from_iterable(Path(f"/proc/self/net/{kind}").read_text().splitlines()[1:] for kind in ("tcp", "tcp6"))
    rows = [words for words in map(str.split, lines) if words[3] == LISTENS and f"socket:[{words[9]}]" in own]
    return [(address, int(port, 16)) for address, port in (words[1].split(":") for words in rows)]


def shown_frame(page) -> int:
    """Of the line in the panel that tells of one; -1 without."""
    words = page.run("return document.body.innerText").partition("frame ")[2]
    return int(words.partition(":")[0]) if words[:1].isdigit() else -1


def wait(condition, what):
    end = time.monotonic() + 300.0
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.2)


@pytest.mark.slow
def test_a_browser_sees_the_map_grow_and_the_run_has_the_bits_of_one_that_nobody_watches(
    tmp_path, monkeypatch, capsys, exact_run, request
):
    """The run stands still at two of its frames until the page, which stays connected between them, shows the map.

    Without Chromium nobody looks, and the bits are the same.
    """
    pytest.importorskip("viser", reason="the viewer's extra: pip install -e .[viewer]")
    page = request.getfixturevalue("chromium").fresh() if MISSING is None else None
    port, frames, sockets = free_port(), [], []

    def looked_at(session, *rest):
        for row, view in enumerate(map_frames(session, *rest)):
            if row == 2:
                sockets.extend(listening())
            if page is not None and row == 2:
                page.visit(f"http://127.0.0.1:{port}")
                wait(lambda: share_of_the_map(page) > 0.2, "the page shows no map")
            if page is not None and row in (2, NUM_FRAMES - 1):
                wait(lambda: shown_frame(page) > max(frames, default=-1), f"the page stays at frame {frames}")
                frames.append(shown_frame(page))
            yield view

    monkeypatch.setattr(experiments.run, "map_frames", looked_at)
    monkeypatch.setattr(live, "SHARE", np.inf)  # drawn at every frame, however long it takes
    watched = compose("prior.level=0", "view=live", f"view.port={port}", "view.every_s=0.1")
    experiments.run.run(watched, tmp_path)
    said = capsys.readouterr().out
    assert f"http://127.0.0.1:{port} shows the run" in said and f"emgs view {tmp_path} shows the finished" in said
    assert (LOOPBACK, port) in sockets and {address for address, _ in sockets} == {LOOPBACK}
    for name in ("map.npz", "trajectory.txt"):
        assert (tmp_path / name).read_bytes() == (exact_run[0] / name).read_bytes()
    if page is not None:
        assert 0 <= frames[0] < frames[1] < NUM_FRAMES
        asked = {address.split("/")[2] for address in page.requests() if address.startswith(("http", "ws"))}
        assert asked == {f"127.0.0.1:{port}"}
        page.fresh()


@pytest.mark.slow
def test_a_browser_sees_what_a_camera_sees_while_it_runs(tmp_path, monkeypatch, request):
    """The camera goes to and fro and never ends; the page ends it when it has shown two frames, rates and the map."""
    pytest.importorskip("viser", reason="the viewer's extra: pip install -e .[viewer]")
    if MISSING is not None:
        pytest.skip(MISSING)
    page, port, shown = request.getfixturevalue("chromium").fresh(), free_port(), []

    def to_and_fro(source, into):
        frames = [*dataset()]
        for row, frame in enumerate(cycle([*frames, *frames[-2:0:-1]])):
            given = {"depth": frame.depth, "T_world_camera": frame.T_world_camera}
            yield Shot(100.0 + row / 20, frame.image, given)
            time.sleep(1 / 20)

    def words() -> tuple[int, int, int, int] | None:
        """Of the panel: the frame, how many are mapped, lost and dropped."""
        text = page.run("return document.body.innerText")
        found = re.search(r"(\d+) frames, (\d+) lost, [\d.]+ maps/s, (\d+) dropped, [\d.]+ s behind", text)
        return None if found is None else (shown_frame(page), *map(int, found.groups()))

    def looked_at(session, *rest):
        for row, view in enumerate(map_frames(session, *rest)):
            yield view
            if row == 2:
                page.visit(f"http://127.0.0.1:{port}")
                wait(lambda: share_of_the_map(page) > 0.2, "the page shows no map")
            if row in (4, 12):
                wait(
                    lambda: words() is not None and words()[0] > max((one[0] for one in shown), default=-1), "no rates"
                )
                shown.append(words())
                assert page.run("return [...document.images].some(image => image.naturalWidth === 64)"), "no image"
            if row == 12:
                end_all()

    monkeypatch.setattr(capture, "open_source", to_and_fro)
    monkeypatch.setattr(experiments.run, "map_frames", looked_at)
    monkeypatch.setattr(live, "SHARE", np.inf)
    camera = "dataset=camera", "dataset.source=7", "dataset.size=[64,48]", "prior=stream"
    camera = *camera, "dataset.intrinsics=[{},{},{},{}]".format(*dataset().intrinsics)
    of_room = [word for word in TINY if not word.startswith("dataset.")]
    watch = "view=live", f"view.port={port}", "view.every_s=0.1"
    metrics = experiments.run.run(configure.compose(*of_room, *camera, *watch), tmp_path)
    (first, count, lost, dropped), (last, later_count, _, later_dropped) = shown
    assert first < last and count < later_count and lost == 0 and 0 < dropped < later_dropped
    assert metrics["frames/lost"] == 0 and metrics["camera/num_dropped"] >= later_dropped
    page.fresh()

"""report.html in Chromium, from file://; oracles: our own renderer at the same camera, a wall that hides another."""

import base64
import io
import json

import jax
import numpy as np
import pytest
from browser import MISSING, browser
from PIL import Image
from written_run import INTRINSICS, SIZE, written_run

from emgs_jax.gaussian_map import confirmed
from emgs_jax.ops.camera import Camera
from emgs_jax.render.composite import render
from emgs_jax.report.page import render_config, write_report
from emgs_jax.report.recorded_run import read_run
from emgs_jax.running.convert import to_se3

pytestmark = pytest.mark.skipif(MISSING is not None, reason=str(MISSING))
BACKGROUND = np.array([0.086, 0.098, 0.118])  # main.js
PIXELS = """
const [row, width, height, focal, center] = arguments, { splats, arrays } = report, { gl, canvas } = splats;
[canvas.width, canvas.height] = [width, height];
splats.draw(poseAt(arrays.poses, row), { focal, center }, null);
const pixels = new Uint8Array(4 * width * height);
gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
report.draw(1);
return btoa(String.fromCharCode(...pixels));
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    run = read_run(written_run(tmp_path_factory.mktemp("run")))
    write_report(run, None)
    return run


@pytest.fixture(scope="module")
def page(run):
    with browser() as page:
        page.open(run.folder / "report.html")
        yield page


def drawn_by_the_page(page, row: int, size, intrinsics) -> np.ndarray:
    """RGB in [0, 1], (h, w, 3), at the camera of a frame."""
    text = page.run(PIXELS, row, *size, intrinsics[:2], intrinsics[2:])
    pixels = np.frombuffer(base64.b64decode(text), np.uint8).reshape(size[1], size[0], 4)
    return pixels[::-1, :, :3] / 255.0  # WebGL's first row is the lowest


def drawn_by_us(run, row: int, size, intrinsics) -> np.ndarray:
    gaussians, camera = confirmed(run.map), Camera(intrinsics[:2], intrinsics[2:], *size)
    drawing = jax.device_get(render(gaussians, gaussians.colors, to_se3(run.poses[row]), camera, render_config(run)))
    return np.asarray(drawing.values) + (1 - np.asarray(drawing.alpha)[..., None]) * BACKGROUND


def shown(page) -> np.ndarray:
    """The window, RGB in [0, 1], cut to the map."""
    image = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")) / 255.0
    box = page.run(
        "const b = document.getElementById('view').getBoundingClientRect(); return [b.x, b.y, b.right, b.bottom]"
    )
    left, top, right, bottom = (round(value) for value in box)
    return image[top:bottom, left:right]


def psnr(a, b) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def rest(page):
    """Wait until what a move asked for is drawn in full."""
    page.run("return new Promise((done) => setTimeout(done, 600))")


def test_the_map_is_drawn_and_not_a_blank(page):
    page.run("report.showFrame(5)")
    rest(page)
    image = shown(page)
    assert (np.abs(image - BACKGROUND).max(-1) > 0.05).mean() > 0.3
    assert len(np.unique((32 * image).astype(int).reshape(-1, 3), axis=0)) > 30


@pytest.mark.parametrize("row", [0, 5])
@pytest.mark.parametrize("factor", [1, 3])
def test_the_page_draws_what_our_renderer_draws(page, run, row, factor):
    """At the image's own size, and at one as large as people look at. 35 dB: WebGL blends in steps of a 255th."""
    size = SIZE[0] * factor, SIZE[1] * factor
    intrinsics = [factor * value for value in INTRINSICS]
    theirs, ours = drawn_by_the_page(page, row, size, intrinsics), drawn_by_us(run, row, size, intrinsics)
    assert psnr(theirs, ours) > 35
    assert psnr(np.roll(theirs, 1, axis=1), ours) < psnr(theirs, ours) - 3  # half a pixel would be seen


def test_a_near_wall_hides_a_far_one(page):
    """It is the first in the map: without sorting the green one would be drawn over it."""
    image = drawn_by_the_page(page, 0, SIZE, INTRINSICS)
    left = image[5:-5, 3:15].reshape(-1, 3)
    assert (left[:, 0] > left[:, 1]).mean() > 0.99


def test_another_class_recolours_the_map(page):
    page.run("report.home()")
    page.run("const s = document.getElementById('layer'); s.value = 'class'; s.dispatchEvent(new Event('input'))")
    rest(page)
    before = shown(page)
    page.run("const s = document.getElementById('word'); s.value = '1'; s.dispatchEvent(new Event('input'))")
    rest(page)
    after = shown(page)
    assert (np.abs(after - before).max(-1) > 0.1).mean() > 0.05
    assert page.run("return document.getElementById('legend').textContent") == "wallsofa"
    page.run("const s = document.getElementById('layer'); s.value = 'color'; s.dispatchEvent(new Event('input'))")


def test_every_layer_is_drawn(page):
    pictures = []
    for name in ("color", "class", "similarity", "feature", "normal", "existence", "birth"):
        page.run(
            "const s = document.getElementById('layer'); s.value = arguments[0]; s.dispatchEvent(new Event('input'))",
            name,
        )
        pictures.append(drawn_by_the_page(page, 0, SIZE, INTRINSICS))
    different = [np.abs(a - b).mean() > 0.02 for k, a in enumerate(pictures) for b in pictures[:k]]
    assert sum(different) >= 20  # of 21 pairs: in this map certainty and birth are each the same everywhere
    page.run("const s = document.getElementById('layer'); s.value = 'color'; s.dispatchEvent(new Event('input'))")


def test_dragging_turns_the_map_and_the_wheel_of_frames_stays(page):
    page.run("report.home()")
    rest(page)
    before, view = shown(page), page.run("return report.state.view.position")
    page.pointer(("move", 500, 350), ("down", 500, 350), ("move", 620, 380), ("up", 620, 380))
    rest(page)
    assert (np.abs(shown(page) - before).max(-1) > 0.1).mean() > 0.03
    pivot, moved = page.run("return report.state.pivot"), page.run("return report.state.view.position")
    assert np.linalg.norm(np.subtract(moved, view)) > 0.1
    assert np.isclose(*(np.linalg.norm(np.subtract(point, pivot)) for point in (view, moved)), rtol=1e-6)  # an orbit


def test_a_click_on_the_strip_goes_to_that_frame(page, run):
    box = page.run(
        "const b = document.getElementById('track').getBoundingClientRect();"
        "document.getElementById('track').scrollIntoView({block: 'end'});"
        "const c = document.getElementById('track').getBoundingClientRect(); return [c.x, c.y, c.width, c.height]"
    )
    x, y = box[0] + box[2] * 4.5 / 6, box[1] + 12
    page.pointer(("down", x, y), ("up", x, y))
    rest(page)
    assert page.run("return [report.state.frame, report.state.atFrame]") == [4, True]
    np.testing.assert_allclose(page.run("return report.state.view.position"), run.poses[4][:3, 3], atol=1e-6)
    assert "frame 4" in page.run("return document.getElementById('facts').textContent")
    assert page.run("return document.getElementById('rendered').naturalWidth") > 0
    page.run("window.scrollTo(0, 0)")


def test_the_ruler_measures_between_two_clicks(page):
    """Both on the near wall, 1 m away, seen from the camera of frame 0: pixels over the focal length are metres."""
    page.run("report.showFrame(0); document.getElementById('ruler').click()")
    rest(page)
    x, y, width, height = page.run(
        "const b = document.getElementById('view').getBoundingClientRect(); return [b.x, b.y, b.width, b.height]"
    )
    focal = min(width / SIZE[0], height / SIZE[1]) * INTRINSICS[0]
    left, right = x + 0.35 * width, x + 0.45 * width
    for at in (left, right):
        page.pointer(("down", at, y + 0.6 * height), ("up", at, y + 0.6 * height))
    a, b = (np.array(point) for point in page.run("return report.state.ruler"))
    np.testing.assert_allclose([a[2], b[2]], 1.0, atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(b - a), (round(right) - round(left)) / focal, rtol=0.01)
    page.run("document.getElementById('ruler').click()")


def test_nothing_is_asked_for_and_nothing_is_wrong(page):
    """Last of all: after everything above."""
    assert {address.split(":")[0] for address in page.requests()} <= {"file", "data", "blob"}
    wrong = [entry for entry in page.log("browser") if entry["level"] == "SEVERE"]
    assert not wrong, json.dumps(wrong)


def test_without_webgl_pictures_and_curves_remain(run, monkeypatch):
    monkeypatch.setattr("browser.FLAGS", ("--headless", "--no-sandbox", "--disable-dev-shm-usage", "--disable-3d-apis"))
    with browser() as page:
        page.open(run.folder / "report.html")
        assert "cannot be drawn" in page.run("return document.getElementById('message').textContent")
        page.run("report.showFrame(2)")
        assert page.run("return document.getElementById('rendered').naturalWidth") > 0

"""report.html in Chromium, from file://; oracles: our own renderer at the same camera, a wall that hides another."""

import base64
import io
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from test_sample_page import SAMPLE
from written_run import INTRINSICS, SIZE, two_walls, written_run

from emgs_jax.device.arrays import to_se3
from emgs_jax.drawing.layers import closing_covariances
from emgs_jax.gaussian_map import confirmed
from emgs_jax.io.ply import save_gaussians_ply
from emgs_jax.ops.camera import Camera
from emgs_jax.polish.splats import draw
from emgs_jax.render.composite import render
from emgs_jax.report.page import write_report
from emgs_jax.runs.finished_run import read_run, render_config

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("browser")]

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


def splats_of_the_run():
    """Means, covariances, colours and opacities as `emgs polish` may leave them: blue walls, the far one half clear."""
    walls = two_walls()
    is_near = np.asarray(walls.features)[:, 1] > 0.5
    return walls.means, 0.5 * walls.covs, np.asarray(walls.colors)[:, ::-1], np.where(is_near, 0.95, 0.5), walls.normals


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    run = read_run(written_run(tmp_path_factory.mktemp("run")))
    save_gaussians_ply(run.folder / "splats.ply", *splats_of_the_run())
    write_report(run, None)
    return run


@pytest.fixture(scope="module")
def page(run, chromium):
    page = chromium.fresh()
    page.open(run.folder / "report.html")
    return page


@pytest.fixture(autouse=True)
def begun(page):
    """Every test begins with the whole map in its own colours."""
    choose(page, "kind", "gaussians")
    choose(page, "layer", "color")
    page.run("window.scrollTo(0, 0); report.home()")
    drawn_in_full(page)


def choose(page, name: str, value: str) -> None:
    page.run(
        "const e = document.getElementById(arguments[0]); e.value = arguments[1]; e.dispatchEvent(new Event('input'))",
        name,
        value,
    )


def drawn_in_full(page) -> None:
    """What a move asked for is drawn before the next picture but one; then the map is, without its coarse drawing."""
    page.run(
        "return new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() =>"
        "{ report.draw(1); requestAnimationFrame(done); })))"
    )


def drawn_by_the_page(page, row: int, size, intrinsics) -> np.ndarray:
    """RGB in [0, 1], (h, w, 3), at the camera of a frame."""
    text = page.run(PIXELS, row, *size, intrinsics[:2], intrinsics[2:])
    pixels = np.frombuffer(base64.b64decode(text), np.uint8).reshape(size[1], size[0], 4)
    return pixels[::-1, :, :3] / 255.0  # WebGL's first row is the lowest


def drawn_by_us(run, row: int, size, intrinsics) -> np.ndarray:
    gaussians, camera = confirmed(run.map), Camera(intrinsics[:2], intrinsics[2:], *size)
    closed = closing_covariances(gaussians.means, gaussians.covs, gaussians.normals)  # all rows of this map are in use
    gaussians = eqx.tree_at(lambda g: g.covs, gaussians, closed.astype(np.float32))
    drawing = jax.device_get(render(gaussians, gaussians.colors, to_se3(run.poses[row]), camera, render_config(run)))
    return np.asarray(drawing.values) + (1 - np.asarray(drawing.alpha)[..., None]) * BACKGROUND


def box_of(page, name: str) -> tuple[float, float, float, float]:
    """Left, top, width and height of an element in the window."""
    words = "const b = document.getElementById(arguments[0]).getBoundingClientRect(); "
    return tuple(page.run(f"{words}return [b.x, b.y, b.width, b.height]", name))


def shown(page) -> np.ndarray:
    """The window, RGB in [0, 1], cut to the map."""
    drawn_in_full(page)
    image = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")) / 255.0
    x, y, width, height = box_of(page, "view")
    return image[round(y) : round(y + height), round(x) : round(x + width)]


def psnr(a, b) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def test_the_page_draws_what_our_renderer_draws(page, run):
    """At a size as large as people look at. 35 dB: WebGL blends in steps of a 255th.

    The near wall, which is the first in the map, hides the far one: without sorting that would be drawn over it.
    """
    size, intrinsics = (3 * SIZE[0], 3 * SIZE[1]), [3 * value for value in INTRINSICS]
    theirs, ours = drawn_by_the_page(page, 5, size, intrinsics), drawn_by_us(run, 5, size, intrinsics)
    assert psnr(theirs, ours) > 35
    assert psnr(np.roll(theirs, 1, axis=1), ours) < psnr(theirs, ours) - 3  # half a pixel would be seen


PAINTED = """
const { splats, sets, arrays } = report, owner = Array.from(sets.splats.owner);
const colors = owner.map((_, row) => Array.from(splats.colors.slice(4 * row, 4 * row + 3)));
return [colors, owner.map((row) => arrays.label[row]), ABOUT];
"""


def test_the_page_draws_the_splats_of_a_polished_run_as_they_were_fitted(page, run):
    """The oracle is the drawing that `emgs polish` fits, each splat in its own opacity; then the map is back."""
    size, intrinsics = (3 * SIZE[0], 3 * SIZE[1]), [3 * value for value in INTRINSICS]
    before = drawn_by_the_page(page, 5, size, intrinsics)
    choose(page, "kind", "splats")
    theirs = drawn_by_the_page(page, 5, size, intrinsics)
    means, covs, colors, opacity, normals = splats_of_the_run()
    walls = eqx.tree_at(lambda g: (g.covs, g.colors), two_walls(), (covs, jnp.asarray(colors)))
    config = replace(render_config(run), covariance_scale=1.0, blur=0.3, radius=3.0, opacity=1.0)
    drawn = jax.device_get(
        draw(
            walls,
            jnp.asarray(opacity, jnp.float32),
            to_se3(run.poses[5]),
            Camera(intrinsics[:2], intrinsics[2:], *size),
            config,
        )
    )
    ours = np.asarray(drawn.values) + (1 - np.asarray(drawn.alpha)[..., None]) * BACKGROUND
    assert psnr(theirs, ours) > 35 and psnr(theirs, before) < 25
    choose(page, "layer", "class")
    choose(page, "word", "1")
    colors, labels, about = page.run(PAINTED)
    is_sofa = np.array(labels) == 1
    assert is_sofa.any() and not is_sofa.all()
    np.testing.assert_array_equal(np.array(colors)[is_sofa], [about["classColors"][1]] * is_sofa.sum())
    greys = np.array(colors)[~is_sofa]
    assert (greys[:, 0] == greys[:, 1]).all(), "what is not asked for fades"
    choose(page, "word", "-1")
    choose(page, "layer", "color")
    np.testing.assert_array_equal(drawn_by_the_page(page, 5, size, intrinsics), theirs)
    choose(page, "kind", "gaussians")
    np.testing.assert_array_equal(drawn_by_the_page(page, 5, size, intrinsics), before)


WHOLE = """
const { state, arrays, splats } = report, { canvas } = splats, lens = report.lens(canvas.width, canvas.height);
const { position, right, down, ahead } = state.view, count = arrays.mean.length / 3;
let inside = 0;
for (let row = 0; row < count; row++) {
  const from = sub(Array.from(arrays.mean.slice(3 * row, 3 * row + 3)), position), z = dot(ahead, from);
  const x = (lens.focal[0] * dot(right, from)) / z + lens.center[0];
  const y = (lens.focal[1] * dot(down, from)) / z + lens.center[1];
  inside += z > 0 && x > 0 && y > 0 && x < canvas.width && y < canvas.height;
}
return inside / count;
"""


def test_the_whole_map_is_in_the_window(page):
    """Also after a frame was left, whose lens the view keeps; a hundredth at each end does not count."""
    assert page.run(WHOLE) > 0.98
    page.run("report.state.focal = 3; report.draw(1)")
    assert page.run(WHOLE) < 0.98
    page.run("report.home()")
    assert page.run(WHOLE) > 0.98


def test_another_class_recolours_the_map(page):
    choose(page, "layer", "class")
    before = shown(page)
    choose(page, "word", "1")
    assert (np.abs(shown(page) - before).max(-1) > 0.1).mean() > 0.05
    assert page.run("return document.getElementById('legend').textContent") == "wallsofa"
    choose(page, "word", "-1")


def test_every_layer_is_drawn(page):
    pictures = []
    for name in ("color", "class", "similarity", "feature", "normal", "existence", "birth"):
        choose(page, "layer", name)
        pictures.append(drawn_by_the_page(page, 0, SIZE, INTRINSICS))
    different = [np.abs(a - b).mean() > 0.02 for k, a in enumerate(pictures) for b in pictures[:k]]
    assert sum(different) >= 20  # of 21 pairs: in this map certainty and birth are each the same everywhere


def test_dragging_turns_the_map_about_its_middle(page):
    before, view = shown(page), page.run("return report.state.view.position")
    page.pointer(("move", 500, 350), ("down", 500, 350), ("move", 620, 380), ("up", 620, 380))
    assert (np.abs(shown(page) - before).max(-1) > 0.1).mean() > 0.03
    pivot, moved = page.run("return report.state.pivot"), page.run("return report.state.view.position")
    assert np.linalg.norm(np.subtract(moved, view)) > 0.1
    assert np.isclose(*(np.linalg.norm(np.subtract(point, pivot)) for point in (view, moved)), rtol=1e-6)  # an orbit


def test_a_click_on_the_strip_goes_to_that_frame(page, run):
    page.run("document.getElementById('track').scrollIntoView({block: 'end'})")
    x, y, width, _ = box_of(page, "track")
    at = x + width * 4.5 / 6, y + 12
    page.pointer(("down", *at), ("up", *at))
    assert page.run("return [report.state.frame, report.state.atFrame]") == [4, True]
    np.testing.assert_allclose(page.run("return report.state.view.position"), run.poses[4][:3, 3], atol=1e-6)
    assert "frame 4" in page.run("return document.getElementById('facts').textContent")
    page.run("return document.getElementById('rendered').decode()")  # waits for the picture
    assert page.run("return document.getElementById('rendered').naturalWidth") > 0


def test_a_frame_that_is_not_placed_has_a_picture_and_no_place(page, run):
    """Symptom: its camera was drawn at a guess, as if it were known."""
    page.run("report.showFrame(4)")
    before = page.run("return report.state.view.position")
    page.run("report.showFrame(3)")
    assert page.run("return [report.state.frame, report.state.view.position]") == [3, before]
    cameras = """
    const found = [], {segment, dot} = report.overlay;
    report.state.atFrame = false;
    report.state.paths = {};
    report.draw(1);
    const drawn = (row) => {
      let count = 0;
      report.overlay.segment = () => count++;
      report.overlay.dot = () => count++;
      report.overlay.camera(row, (p) => p.slice(0, 2), report.state.view);
      return count;
    };
    return [drawn(3), drawn(4)];
    """
    assert page.run(cameras) == [0, 9]


def test_the_ruler_measures_between_two_clicks(page):
    """Both on the near wall, 1 m away, seen from the camera of frame 0: pixels over the focal length are metres."""
    page.run("report.showFrame(0); document.getElementById('ruler').click()")
    drawn_in_full(page)
    x, y, width, height = box_of(page, "view")
    focal = min(width / SIZE[0], height / SIZE[1]) * INTRINSICS[0]
    left, right = x + 0.35 * width, x + 0.45 * width
    for at in (left, right):
        page.pointer(("down", at, y + 0.6 * height), ("up", at, y + 0.6 * height))
    a, b = (np.array(point) for point in page.run("return report.state.ruler"))
    np.testing.assert_allclose([a[2], b[2]], 1.0, atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(b - a), (round(right) - round(left)) / focal, rtol=0.01)
    page.run("document.getElementById('ruler').click()")


def test_the_background_is_light_where_it_is_asked_for(page):
    page.run("document.getElementById('light').click()")
    light = shown(page)
    page.run("document.getElementById('light').click()")
    dark = shown(page)
    assert light[-60:-50, -30:].min() > 0.9 and dark[-60:-50, -30:].max() < 0.2, "a corner without a map"


INSIDE = """
const { overlay, state, arrays } = report, { canvas } = overlay, pose = poseAt(arrays.poses, state.frame);
const { fx, fy, cx, cy, width, height } = ABOUT.camera, lens = report.lens(canvas.width, canvas.height);
const colors = [];
for (const [x, y] of [[0.15, 0.35], [0.85, 0.35], [0.15, 0.65], [0.85, 0.65]]) { // no edge of the pyramid is there
  const far = mul([(x * width - cx) / fx, (y * height - cy) / fy, 1], 0.06 * state.size);
  const p = toCamera(state.view, toWorld(pose, far));
  const at = [0, 1].map((k) => Math.round((lens.focal[k] * p[k]) / p[2] + lens.center[k]));
  colors.push([...overlay.context.getImageData(...at, 1, 1).data]);
}
return colors;
"""


def test_the_image_of_the_chosen_frame_is_in_its_pyramid(page):
    """A picture in four colours, one in each quarter, seen from behind the camera: each is where it belongs."""
    quarters = np.array([[[250, 0, 0], [0, 250, 0]], [[0, 0, 250], [250, 250, 0]]], np.uint8)
    file = io.BytesIO()
    Image.fromarray(quarters.repeat(24, 0).repeat(24, 1)).save(file, "PNG")
    address = "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()
    page.run(
        "report.showFrame(0, false); const [e, s] = [document.getElementById('seen'), report.state]; s.image = e;"
        "const p = poseAt(report.arrays.poses, 0); s.view = { ...p, position: add(p.position, mul(p.ahead, -1)) };"
        "s.atFrame = false; e.src = arguments[0]; return e.decode()",
        address,
    )
    drawn_in_full(page)
    found = np.array(page.run(INSIDE))[:, :3].reshape(2, 2, 3)
    np.testing.assert_allclose(found, quarters, atol=3)


def test_lengths_are_units_where_nothing_tells_their_scale(page):
    assert page.run("return lengthText(0.25)") == "25.0 cm"
    words = "ABOUT.isMetric = false; const text = lengthText(0.25); ABOUT.isMetric = true; return text"
    assert page.run(words) == "0.250 units"


def test_nothing_is_asked_for_and_nothing_is_wrong(page, run):
    """After a reload and a look at every frame; the logs have what the tests before did, too."""
    page.open(run.folder / "report.html")
    for row in range(6):
        page.run("report.showFrame(arguments[0])", row)
        drawn_in_full(page)
    assert {address.split(":")[0] for address in page.requests()} <= {"file", "data", "blob"}
    assert not page.errors()


def test_without_webgl_pictures_and_curves_remain(page, run):
    with page.before_pages("HTMLCanvasElement.prototype.getContext = () => null"):
        page.open(run.folder / "report.html")
        assert "cannot be drawn" in page.run("return document.getElementById('message').textContent")
        page.run("report.showFrame(2); return document.getElementById('rendered').decode()")
        assert page.run("return document.getElementById('rendered').naturalWidth") > 0
    page.open(run.folder / "report.html")
    page.errors()


def test_the_committed_sample_opens_with_the_parts_that_pages_have_now(page, run):
    """docs/report.html, which README links to: drawn by its own program, with the elements of a page written today."""
    elements = "return [...document.querySelectorAll('[id]')].map((e) => e.id).filter((id) => id !== 'wordBox').sort()"
    own = page.run(elements)
    page.open(SAMPLE)
    assert page.run(elements) == own
    count, seen = page.run("return [report.splats.count, report.arrays.poses.length / 12]")
    assert count > 1000 and seen == 40
    assert (np.abs(shown(page) - BACKGROUND).max(-1) > 0.05).mean() > 0.2, "a map is drawn"
    assert not page.errors()
    page.open(run.folder / "report.html")

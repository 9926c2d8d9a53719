"""emgs view: what is asked is answered right (hand-made cosines and rays), and in Chromium the words reach the map."""

import contextlib
import io
import socket
import sys
import time
from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from PIL import Image
from written_run import CLASSES, two_walls, written_run

from emgs_jax.drawing.layers import closing_covariances, covariances, map_layers, painted
from emgs_jax.io.ply import save_gaussians_ply
from emgs_jax.ops.camera import Camera
from emgs_jax.runs.finished_run import read_run
from emgs_jax.viewer.answers import ask, find_words, highlighted, picked
from emgs_jax.viewer.scene import field_of_view, shown
from emgs_jax.viewer.viewer import HOST, Viewer

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("browser")]

NAMES = ("wall", "sofa", "sofa table", "Chair")


def free_port() -> int:
    with socket.socket() as free:
        free.bind((HOST, 0))
        return free.getsockname()[1]


@pytest.mark.parametrize(
    "text, rows, num_unknown",
    [
        ("wall", [0], 0),
        (" Sofa , chair", [1, 3], 0),
        ("sofa", [1], 0),
        ("sofa t", [2], 0),
        ("so", [], 1),
        ("cha", [3], 0),
        ("lamp,wall", [0], 1),
        (" , ", [], 0),
        ("../../etc/passwd", [], 1),
    ],
)
def test_words_are_class_names_also_while_they_are_typed(text, rows, num_unknown):
    assert find_words(text, NAMES) == (rows, num_unknown)


def test_an_answer_is_close_enough_and_closer_than_to_what_is_not_asked_for():
    similarity = np.array([[255, 0, 0], [204, 230, 0], [100, 0, 0], [204, 204, 0], [0, 0, 255]], np.uint8)
    layers = {"similarity": similarity, "label": np.array([0, 1, 0, 0, 2], np.int16)}

    def found(*question):
        return ask(layers, *question).is_found.tolist()

    assert found([0], [], 0.5) == [True, True, False, True, False]
    assert found([0], [1], 0.5) == [True, False, False, False, False], "as close to both is no answer"
    assert found([0, 2], [], 0.5) == [True, True, False, True, True]
    assert found([0], [0], 0.5) == [False] * 5
    layers["label"][0] = -1  # without a feature
    assert found([0], [], 0.0) == [False, True, True, True, True]
    np.testing.assert_allclose(ask(layers, [0], [1], 0.5).cosines, similarity[:, 0] / 255, rtol=1e-6)
    layers["label"][0] = 0
    colors = highlighted(np.full((5, 3), 200, np.uint8), ask(layers, [0], [1], 0.5))
    assert (colors[1:] == 50).all() and colors[0].max() > 150


def test_a_ray_meets_the_first_gaussian_and_none_behind_it():
    """Two discs across the z axis, 1 and 2 m away, half a metre and ten centimetres wide."""
    means = np.array([[0, 0, 2.0], [0, 0, 1.0]])
    covs = np.stack([np.diag([0.25, 0.25, 1e-4]), np.diag([0.01, 0.01, 1e-4])])
    assert picked(means, covs, (0, 0, 0), (0, 0, 1)) == 1
    assert picked(means, covs, (0, 0, 1.5), (0, 0, 1)) == 0
    assert picked(means, covs, (0.4, 0, 0), (0, 0, 1)) == 0, "beside the small one"
    assert picked(means, covs, (0, 0, 3), (0, 0, 1)) is None
    assert picked(means, covs, (2, 0, 0), (0, 0, 1)) is None
    assert picked(means[:0], covs[:0], (0, 0, 0), (0, 0, 1)) is None


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return read_run(written_run(tmp_path_factory.mktemp("run")))


def test_layers_are_those_of_the_map(run):
    layers, walls = map_layers(run.map, run.text), two_walls()
    drawn = closing_covariances(walls.means, walls.covs, walls.normals)
    np.testing.assert_allclose(covariances(layers), drawn, rtol=1e-3, atol=2e-6)
    assert (painted(layers, "normal") == [128, 128, 0]).all()  # all face the cameras, -z
    labels = painted(layers, "class")
    is_sofa = np.asarray(walls.features)[:, 1] > 0.5
    assert len(np.unique(labels[is_sofa], axis=0)) == len(np.unique(labels[~is_sofa], axis=0)) == 1
    assert (labels[is_sofa][0] != labels[~is_sofa][0]).any()
    np.testing.assert_allclose(painted(layers, "color") / 255, walls.colors, atol=0.5 / 255)
    ends_and_middle = np.rint(255 * matplotlib.colormaps["turbo"]([0.0, 0.5, 1.0])[:, :3])
    for name, values in (("updates", [0, 9, 99]), ("birth", [2, 7, 12]), ("existence", [0, 100, 200])):
        np.testing.assert_array_equal(painted({name: np.repeat(values, 100)}, name)[[0, 150, 299]], ends_and_middle)


@pytest.fixture(scope="module")
def viewer(run):
    pytest.importorskip("viser", reason="the viewer's extra: pip install -e .[viewer]")
    viewer = Viewer(shown(run), free_port())
    yield viewer
    viewer.stop()


def test_a_frame_that_is_not_placed_has_no_camera(viewer):
    """Symptom: it stood at a guess, as if it were known."""
    lost = [line["status"] for line in viewer._run.frames].index("lost")
    assert lost not in viewer.scene.frustums and len(viewer.scene.frustums) == len(viewer._run.frames) - 1
    for row in (lost, lost + 1):
        viewer.frame.value = row
        viewer._choose()
        assert viewer.scene.chosen.visible == (row != lost)


def test_the_field_of_view_is_the_angle_between_the_upper_and_the_lower_edge_of_the_image():
    assert np.isclose(field_of_view(Camera((1.0, 50.0), (0.0, 0.0), 30, 100)), np.pi / 2)


def check_colours(viewer, drawn):
    """Words and layers recolour what is served, and it gets its own colours back."""
    is_sofa, before = np.asarray(two_walls().features)[:, 1] > 0.5, np.array(drawn.rgbs)
    viewer.words.value = "sofa"
    viewer.recolor()
    found = np.array(drawn.rgbs)
    assert found[is_sofa].max(1).min() > 130 and found[~is_sofa].max() < 70
    assert f"{is_sofa.sum():,} of {len(is_sofa):,}" in viewer.answer.content
    viewer.against.value = "sofa"
    viewer.recolor()
    assert "0 of" in viewer.answer.content
    viewer.words.value = viewer.against.value = ""
    viewer.layer.value = "normals"
    viewer.recolor()
    for colors in (drawn.rgbs, viewer.scene.points.colors):
        np.testing.assert_array_equal(np.array(colors), painted(viewer.layers, "normal"))
    viewer.layer.value = "colour"
    viewer.recolor()
    np.testing.assert_array_equal(np.array(drawn.rgbs), before)


def test_words_and_layers_recolour_what_is_served(viewer):
    check_colours(viewer, viewer.scene.splats)
    assert viewer.kind.options == ("Gaussians", "points") and viewer.scene.sharp is None


def test_a_polished_run_can_be_shown_as_its_splats(tmp_path):
    walls, folder = two_walls(), written_run(tmp_path / "run")
    save_gaussians_ply(folder / "splats.ply", walls.means, walls.covs, walls.colors, 0.25, walls.normals)
    with looked_for(read_run(folder), "") as polished:
        sharp, gaussians = polished.scene.sharp, polished.scene.splats
        assert polished.kind.options == ("splats", "Gaussians", "points")
        assert (sharp.visible, gaussians.visible) == (True, False)
        np.testing.assert_allclose(sharp.centers, walls.means, atol=1e-6)
        np.testing.assert_allclose(np.ravel(sharp.opacities) / 255, 0.25, atol=0.01)
        check_colours(polished, sharp)
        polished.kind.value = "Gaussians"
        polished._show()
        assert (sharp.visible, gaussians.visible) == (False, True)


def test_a_click_tells_the_numbers_of_the_near_wall(viewer):
    row = np.flatnonzero(np.asarray(two_walls().features)[:, 1] > 0.5)[200]
    x, y, z = np.asarray(two_walls().means)[row]
    viewer.pick((x, y, 0.0), (0.0, 0.0, 1.0))
    assert f"centre {x:.3f}, {y:.3f}, {z:.3f}" in viewer.number.content and "sofa (1.00)" in viewer.number.content
    assert "normal 0.000, 0.000, -1.000" in viewer.number.content
    viewer.pick((0.0, 0.0, -1.0), (0.0, 0.0, -1.0))
    assert "There is no Gaussian." in viewer.number.content


@contextlib.contextmanager
def looked_for(run, words: str):
    """A viewer of its own in which words are looked for."""
    pytest.importorskip("viser", reason="the viewer's extra: pip install -e .[viewer]")
    viewer = Viewer(shown(run), free_port())
    try:
        viewer.words.value = words
        viewer.recolor()
        yield viewer
    finally:
        viewer.stop()


def test_names_from_a_file_are_text_and_no_markup(tmp_path):
    found = read_run(written_run(tmp_path))
    found.frames[0]["reason"] = "<img src=x onerror=alert(1)>"
    text = replace(found.text, names=("<script>", "b"))
    with looked_for(replace(found, text=text), "<script>") as viewer:
        said = [viewer.answer.content, viewer.facts.content]
        viewer.words.value = ""
        viewer.recolor()
        said.append(viewer.answer.content)  # the words that there are
        assert not any("<script" in words or "<img" in words for words in said)
        assert "&lt;script&gt;" in said[0] and "&lt;img" in said[1] and "&lt;script&gt;" in said[2]


def test_a_map_without_features_says_what_a_text_needs(tmp_path):
    folder = written_run(tmp_path)
    (folder / "text.npz").unlink()
    with looked_for(read_run(folder), "sofa") as viewer:
        assert "no features" in viewer.answer.content and "features=dinov3_text" in viewer.answer.content
        assert "class" not in viewer.layer.options


def test_a_missing_extra_is_clear(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ValueError, match=r'pip install "emgs_jax\[viewer\]"'):
        Viewer(shown(run), free_port())


def wait(condition, what, timeout=120.0):
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.2)


def test_in_a_browser_typing_a_word_recolours_and_nothing_is_asked_of_other_machines(viewer, chromium):
    page = chromium.fresh()

    def picture():
        image = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)
        return image[:, :700]  # left of the panel

    def settled():
        """A map, in two pictures alike: it fades in."""
        last = [picture()]

        def is_settled():
            last.append(picture())
            is_drawn = len(np.unique((last[-1] // 16).reshape(-1, 3), axis=0)) > 20
            return is_drawn and np.abs(last[-1] - last[-2]).max() < 8

        wait(is_settled, "no map is drawn")
        return last[-1]

    page.visit(viewer.address)
    wait(viewer.server.get_clients, "no browser has connected")
    wait(lambda: page.run("return document.querySelectorAll('canvas, input').length") > 2, "no page")
    before = settled()
    x, y = page.run(  # the first box that is seen
        "const shown = [...document.querySelectorAll('input')].map(e => e.getBoundingClientRect());"
        "const b = shown.find(e => e.width > 0); return [b.x + b.width / 2, b.y + b.height / 2]"
    )
    page.pointer(("down", x, y), ("up", x, y))
    page.type("sof")  # not to its end
    wait(lambda: viewer.words.value == "sof", "the box does not reach the program")
    wait(lambda: f"Gaussians: {CLASSES[1]}" in viewer.answer.content, "no answer")
    wait(lambda: (np.abs(picture() - before).max(-1) > 40).mean() > 0.05, "the picture is not of other colours")
    wait(lambda: CLASSES[1] in page.run("return document.body.innerText"), "the page does not say what was found")
    assert "Share" not in page.run("return document.body.innerText")
    asked = {address.split("/")[2] for address in page.requests() if address.startswith(("http", "ws"))}
    assert asked == {viewer.address.removeprefix("http://")}
    # viser 1.1.1 says the first of any splats.
    assert not [message for message in page.errors() if "computeBoundingSphere" not in message]
    page.fresh()

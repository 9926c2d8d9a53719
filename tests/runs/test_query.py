"""Questions to a hand-made run, a red wall ("sofa") before a green one ("wall"); oracle: where they stand."""

import contextlib
import io
import json
from dataclasses import replace
from functools import cache

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from omegaconf import OmegaConf
from written_run import written_run

from emgs_jax.config.configure import compose
from emgs_jax.data.labels import LabelFolder
from emgs_jax.drawing.colors import class_colors
from emgs_jax.evaluation.instances import InstanceConfig
from emgs_jax.features.random import RandomFeatures
from emgs_jax.features.text import TextEmbeddings, save_text
from emgs_jax.io.map_file import load_map, save_map
from emgs_jax.io.trajectory import save_trajectory_tum
from emgs_jax.report.query_pictures import MAX_LEGEND, drawn, frame_view, legend, save_labels
from emgs_jax.runs.finished_run import read_run
from emgs_jax.runs.query import Question, ask, heat
from emgs_jax.runs.vocabulary import vocabulary
from experiments.query import asked, given_views, named_views, query, rivals

pytestmark = pytest.mark.slow

FILES = {"query.json", "query.png", "semantic.npz", "semantic.ply", "features.png", "labels"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return written_run(tmp_path_factory.mktemp("runs") / "one")


@cache
def composed(*overrides: str):
    return compose("map=nowhere", *overrides, name="query")


def asking(folder, *overrides: str, **values):
    """The config of a question; a value is that of a key, with __ for its dots."""
    config = composed(*overrides).copy()
    for key, value in ({"map": str(folder)} | values).items():
        OmegaConf.update(config, key.replace("__", "."), value)
    return config


def said(folder, *overrides: str, **values):
    return query(asking(folder, *overrides, **values))


@pytest.fixture(scope="module")
def answered(folder, tmp_path_factory):
    """The answer to "sofa" with class images, its folder, and what the command printed."""
    out, words = tmp_path_factory.mktemp("sofa"), io.StringIO()
    with contextlib.redirect_stdout(words):
        found = said(folder, text="sofa", label_images=True, out=str(out))
    return found, out, words.getvalue()


def test_the_object_has_its_place_and_every_file_says_the_same(folder, answered):
    """The near wall is at z = 1, from x = -1.5 to .46 and y = -1.5 to 1.46; its features are those of "sofa"."""
    found, out, printed = answered
    assert {path.name for path in out.iterdir()} == FILES
    assert json.loads((out / "query.json").read_text())["words"][0]["word"] == "sofa"
    means = np.asarray(load_map(folder / "map.npz").gaussians.means, np.float64)
    near = means[:, 2] == 1.0
    (word,) = found["words"]
    (sofa,) = word["instances"]
    assert word["num_gaussians"] == sofa["num_gaussians"] == near.sum()
    np.testing.assert_allclose(sofa["center_m"], means[near].mean(0), atol=1e-6)
    np.testing.assert_allclose(sofa["low_m"][0], -1.5 - np.sqrt(3e-3), atol=1e-6)
    np.testing.assert_allclose([sofa["score"], sofa["lead"]], [1.0, 1.0])
    assert found["against"] == ("wall",) and found["features"]["bytes_per_gaussian"] == 8
    arrays = np.load(out / "semantic.npz")
    header = json.loads(str(arrays["header"]))
    assert header["words"] == ["sofa"] and arrays["features"].dtype == np.float16
    np.testing.assert_array_equal(arrays["labels"], np.where(near, 0, -1))
    np.testing.assert_array_equal(arrays["instances"], np.where(near, 0, -1))
    np.testing.assert_array_equal(arrays["means"], means)
    np.testing.assert_array_equal(arrays["features"], np.where(near[:, None], [0, 1], [1, 0]))
    vertices = trimesh.load(out / "semantic.ply").metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(vertices["label"], np.where(near, 0, -1))
    assert f"sofa: {near.sum()} Gaussians, 1 objects" in printed and "8 bytes each, 4 in semantic.npz" in printed


def test_negative_words_a_margin_and_a_least_cosine_say_none_of_these(folder, tmp_path):
    """The walls' features are (0, 1) and (1, 0); "a" at (.6, .8) is nearer to one, "b" at (.8, .6) to the other."""
    run = read_run(folder)
    vectors = np.array([[0.6, 0.8], [0.8, 0.6]], np.float32)
    save_text(tmp_path / "e.npz", TextEmbeddings(("a", "b"), vectors, (), {"prior": "simulated"}))

    def count(*words, **values):
        config = asking(folder, text=list(words), **values)
        texts = vocabulary(run, config.features.text, None)
        against = rivals(config, words, texts)
        question = Question(texts.embed(words), against, config.margin, config.min_cosine, InstanceConfig(2.0, 3))
        labels = ask(run, question).relevance.labels
        return [int((labels == word).sum()) for word in range(len(words))]

    both = count("sofa", "wall")
    assert min(both) > 100
    assert count("sofa") == both[:1]
    assert count("sofa", against=[]) == [sum(both)]  # with nothing else, everything is a sofa
    assert count("sofa", against=[], min_cosine=0.5) == both[:1]
    assert count("sofa", against="wall", margin=1.1) == [0]
    path = str(tmp_path / "e.npz")
    assert count("a", features__text=path) == count("a", features__text=path, margin=0.19) == both[:1]
    assert count("a", features__text=path, margin=0.21) == [0]
    assert count("a", features__text=path, against="b", margin=0.21) == [0]


def test_heat_runs_from_the_first_to_the_last_hundredth_of_the_leads_that_are_known(folder):
    run = read_run(folder)
    texts, leads = vocabulary(run, None, None), np.random.default_rng(0).normal(0.3, 2.0, (len(run.map.birth), 1))
    answer = ask(run, Question(texts.embed(["sofa"]), texts.embed(["wall"]), 0.0, 0.0, InstanceConfig(2.0, 3)))
    answer = replace(answer, relevance=eqx.tree_at(lambda r: r.leads, answer.relevance, leads), rows=answer.rows[50:])
    expected = np.interp(leads[50:, 0], np.percentile(leads[50:], [1, 99]), [0.0, 1.0])
    np.testing.assert_allclose(heat(answer, 0), [*[np.nan] * 50, *expected], atol=1e-9)


def test_class_images_show_each_word_where_it_is_and_are_read_as_labels(folder, answered, tmp_path):
    """The sofa hides the wall as far as column 36 of 64, see below; with ids from 1, and 0 where nothing is asked."""
    run, labels = read_run(folder), answered[1] / "labels"
    assert len(list(labels.glob("*.png"))) == run.is_placed.sum()
    read = LabelFolder(labels, labels / "classes.txt", (0,))
    pixels = cv2.imread(str(labels / "0.png"), cv2.IMREAD_UNCHANGED)
    assert read.names == ("sofa",) and pixels.dtype == np.uint16
    assert (pixels[8:32, 4:36] == 1).all() and (pixels[8:32, 46:49] == 0).all()
    (tmp_path / "classes.txt").write_text("sofa\nwall\n")
    config = asking(folder, classes=str(tmp_path / "classes.txt"), frame=0)
    words, texts = asked(config), vocabulary(run, None, None)
    assert words == ("sofa", "wall")
    question = Question(texts.embed(words), rivals(config, words, texts), 0.0, 0.0, InstanceConfig(2.0, 3))
    save_labels(tmp_path / "labels", run, ask(run, question), named_views(run, given_views(config, run)))
    image = LabelFolder(tmp_path / "labels", tmp_path / "labels" / "classes.txt", (0,)).read("000000.jpg")
    assert (image[8:32, 4:36] == 0).all() and (image[8:32, 46:49] == 1).all()


def test_the_same_question_gives_the_same_bytes(folder, answered, tmp_path):
    said(folder, text="sofa", out=str(tmp_path))
    for name in FILES - {"labels"}:
        assert (tmp_path / name).read_bytes() == (answered[1] / name).read_bytes(), name


def test_a_rendered_image_shows_each_gaussian_where_it_is(folder):
    run = read_run(folder)
    is_near = (np.asarray(run.map.gaussians.means)[:, 2] == 1.0).astype(np.float32)[:, None]
    image = drawn(run, run.map.gaussians, is_near, frame_view(run, 0), run.camera)[..., 0]
    # The camera looks along z from the origin: what is left of x = .46 at 1 m is pixel 22 + 40 · .46, and the last
    # Gaussians, of two pixels, end three standard deviations from their centres.
    # A tenth of the far wall may shine through, since the opacity is .9.
    assert np.nanmin(image[8:32, 4:36]) > 0.9 and np.nanmax(image[8:32, 46:49]) < 0.05


def test_pictures_are_drawn_from_given_poses_or_frames(folder, tmp_path):
    run, poses = read_run(folder), np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 0.3
    save_trajectory_tum(tmp_path / "poses.txt", [1.0, 2.0], poses)
    views = given_views(asking(folder, pose=str(tmp_path / "poses.txt")), run)
    assert [view.title for view in views] == ["pose at 1", "pose at 2"]
    np.testing.assert_allclose(np.stack([view.pose for view in views]), poses)
    (view,) = given_views(asking(folder, frame=2), run)
    assert view.title == "frame 2" and (view.pose == run.poses[2]).all()
    assert given_views(asking(folder), run) is None


def test_embeddings_of_another_width_or_encoder_are_refused_and_both_are_named(folder, tmp_path):
    wide = TextEmbeddings(("sofa",), np.ones((1, 3), np.float32), (), {"prior": "simulated"})
    save_text(tmp_path / "wide.npz", wide)
    with pytest.raises(ValueError, match=r"wide.npz has embeddings of width 3, and the map's features have width 2"):
        said(folder, text="sofa", features__text=str(tmp_path / "wide.npz"))
    save_text(tmp_path / "other.npz", TextEmbeddings(("sofa",), np.ones((1, 2), np.float32), (), {"name": "clip"}))
    with pytest.raises(ValueError, match=r"other.npz was embedded by .*clip.*, but the features are of .*simulated"):
        said(folder, text="sofa", features__text=str(tmp_path / "other.npz"))
    with pytest.raises(ValueError, match=r"features=random is .*'width': 2.*, but the features of .*simulated"):
        said(folder, "features=random", text="sofa", features__width=2)


def test_a_text_encoder_embeds_any_word_and_what_anything_is_stands_against_it(tmp_path):
    """The features of the near wall are those of the random model for "red chair", the other's those for "things"."""
    folder = written_run(tmp_path / "run")
    model = RandomFeatures(16, 8, 0, (), ["a {}."], None)
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics["provenance"]["prior"]["settings"] = {"features": {"model": model.identity, "templates": []}}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    map = load_map(folder / "map.npz")
    near = np.asarray(map.gaussians.means)[:, 2:] == 1.0
    vectors = model.embed(("red chair", "things")).vectors
    features = jnp.asarray(np.where(near, vectors[0], vectors[1]))
    valid = map.gaussians.valid.at[5].set(False)
    save_map(
        folder / "map.npz", eqx.tree_at(lambda m: (m.gaussians.features, m.gaussians.valid), map, (features, valid))
    )
    found = said(folder, "features=random", text="red chair", features__templates=["a {}."])
    assert found["against"] == ("object", "things", "stuff", "texture")
    (chair,) = found["words"][0]["instances"]
    np.testing.assert_allclose(chair["center_m"][2], 1.0, atol=1e-6)
    np.testing.assert_allclose(chair["score"], 1.0, atol=1e-6)
    arrays = np.load(folder / "semantic.npz")  # of the rows in use
    np.testing.assert_allclose(arrays["features"], np.delete(features, 5, axis=0), atol=1e-3)  # float16
    (folder / "text.npz").unlink()
    with pytest.raises(ValueError, match=r"has no text.npz with words, and its features are of .*random"):
        said(folder, text="red chair")


def test_a_map_without_features_is_named(tmp_path):
    folder = written_run(tmp_path / "run")
    map = load_map(folder / "map.npz")
    for features in (map.gaussians.features[:, :0], 0.0 * map.gaussians.features):
        save_map(folder / "map.npz", eqx.tree_at(lambda m: m.gaussians.features, map, features))
        with pytest.raises(ValueError, match=r"has no features to compare words with: map again with features="):
            said(folder, text="sofa")


def test_the_legend_of_the_classes_has_the_words_that_are_drawn_in_their_colours() -> None:
    names, counts = [f"word {i}" for i in range(40)], [0, 7] + [100] * (MAX_LEGEND - 1) + [3] * 15
    shown = legend(names, counts)
    assert list(shown) == names[1 : MAX_LEGEND + 1]  # no answer, or fewer than others: not there
    np.testing.assert_array_equal(shown["word 1"], class_colors(40)[1])

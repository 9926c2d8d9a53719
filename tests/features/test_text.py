"""Averages over templates by hand, and the file: what was written comes back, nothing else passes for it."""

import json

import numpy as np
import pytest

from emgs_jax.features.text import TextEmbeddings, average_over_templates, load_text, save_text

MODEL = {"name": "random", "width": 3}


@pytest.fixture
def path(tmp_path):
    vectors = np.eye(3, dtype=np.float32)[[2, 0]]
    save_text(tmp_path / "text.npz", TextEmbeddings(("wall", "chair"), vectors, ("a {}.", "the {}."), MODEL))
    return tmp_path / "text.npz"


def test_the_mean_is_over_unit_vectors_and_is_unit_again():
    of_prompt = {"a wall.": [3, 0], "the wall.": [0, 0.5], "a box.": [-2, 0], "the box.": [-1, 0]}
    vectors = average_over_templates(["wall", "box"], ["a {}.", "the {}."], lambda ps: [of_prompt[p] for p in ps])
    assert vectors.dtype == np.float32
    np.testing.assert_allclose(vectors, [[0.5**0.5, 0.5**0.5], [-1, 0]], atol=1e-7)
    for templates in ([], ["no place"], ["a {}", "{} and {}"]):
        with pytest.raises(ValueError, match="features.templates must each have one {}"):
            average_over_templates(["wall"], templates, lambda prompts: np.ones((len(prompts), 2)))


def test_a_file_comes_back_bit_for_bit_whole_or_in_the_order_that_is_asked_for(path):
    text = load_text(path, MODEL)
    assert (text.names, text.templates, text.model) == (("wall", "chair"), ("a {}.", "the {}."), MODEL)
    np.testing.assert_array_equal(text.vectors, [[0, 0, 1], [1, 0, 0]])
    chosen = load_text(path, MODEL, ["chair"])
    assert chosen.names == ("chair",)
    np.testing.assert_array_equal(chosen.vectors, [[1, 0, 0]])


def test_what_does_not_fit_and_a_newer_or_foreign_file_are_refused_with_the_remedy(path):
    with pytest.raises(ValueError, match="text.npz has no embedding of .'lamp'., only of .*experiments.embed"):
        load_text(path, MODEL, ["wall", "lamp"])
    with pytest.raises(ValueError, match="text.npz was embedded by .*'width': 3.*features are of .*'width': 4"):
        load_text(path, MODEL | {"width": 4})
    foreign = path.parent / "foreign.npz"
    for message in ("foreign.npz is no file: .*experiments.embed", "no file of text embeddings"):
        with pytest.raises(ValueError, match=message):
            load_text(foreign, MODEL)
        foreign.write_bytes(b"\x93NUMPY\x01\x00")
    with np.load(path) as arrays:
        header, vectors = json.loads(str(arrays["header"])), arrays["embeddings"]
    for change, message in (
        ({"version": 2}, "version is 2, this code reads 1"),
        ({"format": "other"}, "format is 'other', this code reads 'emgs_jax.text'"),
        ({"names": ["wall"]}, "damaged"),
    ):
        np.savez(path, header=np.array(json.dumps(header | change)), embeddings=vectors)
        with pytest.raises(ValueError, match=message):
            load_text(path, MODEL)
    for wrong in (vectors[0], np.where(vectors > 0, np.nan, vectors), vectors.astype(np.float64)):
        np.savez(path, header=np.array(json.dumps(header)), embeddings=wrong)
        with pytest.raises(ValueError, match="its embeddings are not those of its header"):
            load_text(path, MODEL)

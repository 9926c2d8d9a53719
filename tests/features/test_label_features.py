"""Features from class images: the vector of each pixel's class, zero where there is none, and bad files by name."""

import io
import re

import cv2
import numpy as np
import pytest

from emgs_jax.data.base import BadFrameError, Frame
from emgs_jax.features.base import FeatureModel
from emgs_jax.features.labels import LabelFeatures
from emgs_jax.features.text import TextEmbeddings, save_text

IDS = np.array([[2, 2, 5, 5], [2, 2, 0, 0]], np.uint8)
FRAME = Frame(0, 0.0, "images/a.jpg", np.zeros((2, 4, 3), np.uint8))


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "classes.txt").write_text("2 wall\n5 cup\n")
    cv2.imwrite(str(tmp_path / "a.png"), IDS)
    return tmp_path


def model_of(folder, **options):
    return LabelFeatures(str(folder), str(folder / "classes.txt"), **options)


def test_each_class_has_an_axis_an_unknown_pixel_is_zero_and_labels_are_sampled_at_the_frames_size(folder):
    model = model_of(folder)
    assert isinstance(model, FeatureModel) and model.text.names == ("wall", "cup")
    features = model.extract(FRAME)
    assert features.dtype == np.float16
    np.testing.assert_array_equal(features.argmax(-1)[IDS > 0], (IDS[IDS > 0] == 5).astype(int))
    np.testing.assert_array_equal(np.linalg.norm(features, axis=-1), IDS > 0)
    assert model.identity == {"name": "labels", "version": 1, "classes": ["wall", "cup"]}
    cv2.imwrite(str(folder / "a.png"), np.repeat(np.repeat(IDS, 3, 0), 3, 1))
    np.testing.assert_array_equal(model_of(folder).extract(FRAME), features)


def test_a_file_of_embeddings_gives_the_vectors_and_the_identity(folder):
    vectors = np.array([[0.0, 1, 0], [0.6, 0, 0.8], [1, 0, 0]], np.float32)
    save_text(folder / "t.npz", TextEmbeddings(("cup", "wall", "cat"), vectors, ("a {}",), {"name": "clip"}))
    model = model_of(folder, text=str(folder / "t.npz"))
    np.testing.assert_allclose(model.extract(FRAME)[0], vectors[[1, 1, 0, 0]], atol=1e-3)  # float16
    assert model.identity == {"name": "clip"} and model.embed(("cup",)).vectors.tolist() == [[0, 1, 0]]
    save_text(folder / "t.npz", TextEmbeddings(("cup", "cat"), vectors[:2], (), {"name": "clip"}))
    with pytest.raises(ValueError, match=r"t\.npz has no embedding of \['wall'\]"):
        _ = model_of(folder, text=str(folder / "t.npz")).text


def test_scores_give_the_mean_of_the_vectors_of_more_classes_than_opencv_has_channels_too(folder):
    scores = np.zeros((2, 4, 2), np.float32)
    scores[0, 0], scores[0, 1] = [0.9, 0.3], [0.0, 2.0]
    np.save(folder / "a.npy", scores)
    features = model_of(folder).extract(FRAME)
    np.testing.assert_allclose(features[0, 0], np.array([3, 1]) / np.sqrt(10), atol=1e-3)
    np.testing.assert_array_equal(features[0, 1], [0, 1])
    assert not features[1].any()
    (folder / "classes.txt").write_text("".join(f"{i + 1} class {i}\n" for i in range(700)))
    scores = np.zeros((1, 2, 700), np.float32)
    scores[0, 0, 650], scores[0, 1, 3] = 1.0, 1.0
    np.save(folder / "a.npy", scores)
    np.testing.assert_array_equal(model_of(folder).extract(FRAME).argmax(-1), [[650, 650, 3, 3]] * 2)


def archive() -> bytes:
    file = io.BytesIO()
    np.savez(file, scores=np.zeros((2, 4, 2)))
    return file.getvalue()


def announcing(rows: int) -> bytes:
    """A file whose header says that there are more rows than a computer holds."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": (rows, 4, 2)})
    return file.getvalue() + bytes(64)


@pytest.mark.parametrize(
    ("scores", "problem"),
    [
        (np.zeros((2, 4, 3)), r"must hold scores \(h, w, 2\)"),
        (np.full((2, 4, 2), np.nan), "not finite"),
        (np.full((2, 4, 2), -0.1), "negative"),
        (np.zeros((4, 4, 2)), "not the aspect of the 4x2 frame"),
        (np.array([[["a", "b"]]]), "must hold scores"),
        (np.zeros((0, 0, 2)), "must hold scores"),
        (b"\x93NUMPY\x01\x00\x10", "is no array of scores, or damaged"),
        (archive(), "is no array of scores, or damaged"),
        (announcing(2**40), "is no array of scores, or damaged"),
    ],
)
def test_bad_scores_are_named(folder, scores, problem):
    path = folder / "a.npy"
    path.write_bytes(scores) if isinstance(scores, bytes) else np.save(path, scores)
    with pytest.raises(BadFrameError, match=f"{re.escape(str(path))}.*{problem}"):
        model_of(folder).extract(FRAME)


class Dataset(list):
    name, calibration = "images", {"distortion": [0.0]}

    def files(self, index):
        return self[index]


def test_labels_that_do_not_fit_the_images_or_classes_are_named(folder):
    model, bent = model_of(folder), Dataset([["x/a.png"]])
    model.check(Dataset([["x/a.png"], []]))
    with pytest.raises(ValueError, match=r"b\.png does not exist, nor do those of 1 of 2 images"):
        model.check(Dataset([["x/a.png"], ["x/b.jpg"]]))
    with pytest.raises(ValueError, match="images of several folders have the name a, and classes have one folder"):
        model.check(Dataset([["x/a.png"], ["y/a.png"]]))  # those of the second had the classes of the first
    bent.calibration = {"distortion": [0.1, 0.0]}
    with pytest.raises(ValueError, match="straightens its images"):
        model.check(bent)
    with pytest.raises(ValueError, match=r"\['dog'\] are no classes of .*classes\.txt, which has wall, cup"):
        model.embed(("dog",))
    with pytest.raises(ValueError, match=r"features\.unknown must be a list"):
        model_of(folder, unknown="0")
    assert model.settings["unknown"] is None and model_of(folder, unknown=[0, 7]).settings["unknown"] == [0, 7]
    large = Frame(0, 0.0, "images/a.jpg", np.zeros((120, 160, 3), np.uint8))
    for shape, frame, message in (
        ((4, 4), FRAME, r"a\.png is 4x4, which is not the aspect of the 4x2 frame"),
        ((3, 4), large, r"a\.png is 4x3, too coarse for a frame of 160x120"),
    ):
        cv2.imwrite(str(folder / "a.png"), np.full(shape, 2, np.uint8))
        with pytest.raises(BadFrameError, match=message):
            model_of(folder).extract(frame)

"""Masks: what they leave out is left out of truth and predictions, and what is no mask of an image is said."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_run import compose

from emgs_jax.config.configure import build_dataset, build_prior
from emgs_jax.data.masks import Masks
from emgs_jax.prior.base import windows


def written(folder, names, image):
    folder.mkdir(exist_ok=True)
    for name in names:
        cv2.imwrite(str(folder / f"{name}.png"), image)
    return folder


KEPT = np.uint8(255 * (np.indices((48, 64))[1] >= 20))  # black in the 20 columns of the left


@pytest.mark.parametrize(
    ("image", "more", "columns"),
    [
        (KEPT, {"border": 0}, 20),
        (KEPT, {"border": 3}, 23),
        (cv2.resize(KEPT, (128, 96), interpolation=cv2.INTER_NEAREST), {"border": 0}, 20),
        (np.uint8(7 * (KEPT == 0) + 3 * (KEPT > 0)), {"border": 0, "classes": ["cat", "person"]}, 20),
        (np.uint8(3 * (KEPT > 0)), {"border": 0, "classes": ["person"]}, 0),
    ],
    ids=["binary", "border", "larger", "classes", "no such class"],
)
def test_what_is_black_or_of_a_class_is_left_out_with_a_border(tmp_path, image, more, columns):
    (tmp_path / "names.txt").write_text("3 wall\n7 person\n8 cat\n")
    names = {"names": str(tmp_path / "names.txt")} if "classes" in more else {}
    masks = Masks(str(written(tmp_path / "masks", ["a b"], image)), **more, **names)
    (path,) = masks.files([Path("images/a b.jpg")], [0])
    is_out = masks.fitted(masks.decoded(path, (64, 48)), (64, 48))
    np.testing.assert_array_equal(is_out, np.indices((48, 64))[1] < columns)


def test_frames_and_predictions_have_nothing_there_and_the_image_stays(tmp_path):
    folder = written(tmp_path / "masks", [f"{number:06d}" for number in range(6)], KEPT)
    given, masked = compose(), compose(f"masks.folder={folder}", "masks.border=0")
    plain, dataset = build_dataset(given), build_dataset(masked)
    window = next(windows(range(len(dataset)).__contains__, 3))
    frames, others = ([one[index] for index in window.views] for one in (dataset, plain))
    for frame, other in zip(frames, others, strict=True):
        assert (frame.depth[:, :20] == 0).all() and (frame.labels[:, :20] == -1).all() and frame.mask[:, :20].all()
        np.testing.assert_array_equal(frame.depth[:, 20:], other.depth[:, 20:])
        np.testing.assert_array_equal(frame.image, other.image)
    prior = build_prior(masked, dataset)
    full = [
        frame.__class__(**{**vars(frame), "depth": other.depth}) for frame, other in zip(frames, others, strict=True)
    ]
    for answer in (prior.predict, prior.revisit):  # also of a prior that knows better
        found = answer(window, full, dataset.intrinsics)
        assert not found.mask[:, :, :20].any() and found.mask[:, :, 20:].all()
    assert prior.provenance == build_prior(given, plain).provenance

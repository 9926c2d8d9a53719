"""Files that are numbered from 0 beside images from 1, or the reverse: refused, never each its neighbour's."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from stereo_scene import structure_config

from emgs_jax.data.file_names import check_numbering
from emgs_jax.data.images import Images
from emgs_jax.data.masks import Masks, check_names
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.prior.files.naming import rows_of
from emgs_jax.structure.given import names_at

BLANK, PINHOLE = np.zeros((48, 64, 3), np.uint8), (50.0, 50.0, 31.5, 23.5)


def numbered(first: int, last: int, name: str = "{:06d}", step: int = 1) -> list[str]:
    return [name.format(number) for number in range(first, last + 1, step)]


def folder(root: Path, names: list[str]) -> Path:
    root.mkdir()
    for name in names:
        cv2.imwrite(str(root / f"{name}.png"), BLANK + 255)
    return root


def images(root: Path, first: int, **keys) -> Images:
    """Ten images."""
    return Images(str(folder(root, numbered(first, first + 9))), intrinsics=PINHOLE, **keys)


def video(root: Path, **keys) -> Images:
    root.mkdir()
    writer = cv2.VideoWriter(str(root / "a.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    for _ in range(10):
        writer.write(BLANK)
    writer.release()
    return Images(str(root / "a.avi"), intrinsics=PINHOLE, **keys)


@pytest.mark.parametrize("name", ["{:06d}", "{}", "frame_{:04d}_left", "IMG_2026_{:03d}"])
@pytest.mark.parametrize(
    ("own", "given", "is_off"),
    [
        ((0, 9), (1, 10), True),
        ((1, 10), (0, 9), True),
        ((0, 9), (0, 9), False),
        ((0, 9), (1, 9), False),  # the first one is missing
        ((0, 9), (0, 8), False),
        ((3, 7), (0, 20), False),  # of more images
        ((0, 9), (10, 19), False),  # of others
    ],
)
def test_names_are_off_if_all_are_of_the_next_image_and_one_of_none(name, own, given, is_off):
    own, given = numbered(*own, name), numbered(*given, name)
    if not is_off:
        check_numbering(own, own, given, "X")
        return
    with pytest.raises(ValueError, match=f"X has names from {given[0]} on, the images from {own[0]} on"):
        check_numbering(own, own, given, "X")
    with pytest.raises(ValueError, match="begin alike"):  # though the model lacks some
        check_numbering(own, own, [given[0], *given[3:]], "X")


OFF = "has names from 00000. on, the images from 00000. on, so each would be its neighbour's"


@pytest.mark.parametrize("keys", [{}, {"start": 1}, {"stop": 9}, {"stride": 3}, {"start": 2, "stop": 8}])
@pytest.mark.parametrize("first", [0, 1])
def test_predictions_masks_and_models_of_images_that_are_numbered_otherwise_are_refused(tmp_path, first, keys):
    """Symptom: `dataset.stop`, as advised for the one that was missing, gave each image its neighbour's depth."""
    data = images(tmp_path / "images", first, **keys)
    other, same = numbered(1 - first, 10 - first), numbered(first, first + 9)
    folder(tmp_path / "other", other), folder(tmp_path / "same", same)
    for may_lack in (False, True):
        with pytest.raises(ValueError, match=OFF):
            rows_of(data, other, tmp_path, may_lack)
        assert None not in rows_of(data, same, tmp_path, may_lack)
    if first or "start" in keys:  # else the first is missing, and says so
        with pytest.raises(ValueError, match="begin alike|has no mask"):
            ReadableFrames(data, masks=Masks(str(tmp_path / "other")))
    assert ReadableFrames(data, masks=Masks(str(tmp_path / "same"))).has_masks
    with pytest.raises(ValueError, match=OFF):
        check_names(ReadableFrames(data), other, "prior.structure.model=X")
    check_names(ReadableFrames(data), same[:3], "prior.structure.model=X")


@pytest.mark.parametrize("keys", [{}, {"start": 1}, {"stop": 9}, {"stride": 3}, {"start": 2, "stop": 8}])
def test_a_model_of_ffmpegs_images_of_a_video_is_refused(tmp_path, keys):
    data = video(tmp_path / "video", **keys)
    with pytest.raises(ValueError, match="has names from 000001 on"):
        check_names(data, numbered(1, 10), "prior.structure.model=X")
    check_names(data, numbered(0, 9), "prior.structure.model=X")


def test_a_model_that_lacks_the_first_frame_of_a_video_may_be_ffmpegs_and_the_user_says(tmp_path):
    with pytest.raises(ValueError, match=r"if that is the video's second frame, dataset\.start=1 says so"):
        check_names(video(tmp_path / "a"), numbered(1, 8), "X")
    check_names(video(tmp_path / "b", start=1), numbered(1, 8), "X")


def test_the_names_of_a_model_and_of_a_database_are_found_without_reading_the_points(tmp_path):
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=4)
    with pycolmap.Database.open(tmp_path / "my.db") as database:
        model = pycolmap.synthesize_dataset(options, database)
    (tmp_path / "sparse/0").mkdir(parents=True)
    model.write_binary(tmp_path / "sparse/0")
    expected = {Path(image.name).stem for image in model.images.values()}
    assert names_at(tmp_path / "sparse") == names_at(tmp_path / "sparse/0") == names_at(tmp_path / "my.db") == expected
    assert names_at(tmp_path / "nothing") == set()


def test_the_prior_asks_before_the_structure_is_taken(tmp_path):
    from emgs_jax.config.configure import build, compose

    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=10)
    model = pycolmap.synthesize_dataset(options)
    for number, image in enumerate(sorted(model.images.values(), key=lambda one: one.image_id)):
        image.name = f"{number + 1:06d}.png"
    (tmp_path / "model").mkdir()
    model.write_binary(tmp_path / "model")
    config = compose("prior=multiview_stereo", f"prior.structure.model={tmp_path}/model")
    prior = build(config, "prior", _convert_="all")
    prior.check(video(tmp_path / "video"), 2)
    with pytest.raises(ValueError, match=r"prior\.structure\.model=.*has names from 000001 on"):
        prior.keep(tmp_path / "run")
    assert structure_config().model is None

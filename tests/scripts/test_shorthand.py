"""`emgs run video.mp4`: against the keys that one would type, which Hydra takes."""

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from emgs_jax.config.configure import compose
from emgs_jax.data.reading import about_pixels
from experiments.command import check_arguments
from experiments.shorthand import keys_of, with_source

pytestmark = pytest.mark.slow


@pytest.fixture
def video(tmp_path):
    """Five frames of 96 by 64."""
    path = tmp_path / "it's a walk.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (96, 64))
    for shade in range(5):
        writer.write(np.full((64, 96, 3), 40 * shade, np.uint8))
    writer.release()
    return path


def write_images(folder, millimetres=None):
    folder.mkdir()
    exif = Image.Exif()
    if millimetres is not None:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = millimetres
    for name in ("a.jpg", "b.jpg"):
        Image.fromarray(np.zeros((96, 54, 3), np.uint8)).save(folder / name, exif=exif)
    return folder


def test_a_video_stands_for_the_keys_that_map_it_and_one_line_says_so(video, capsys):
    words = with_source([str(video)])
    found = keys_of(words)
    assert found.pop("dataset.root").strip("'").replace("\\'", "'") == str(video)
    assert found == {
        "dataset": "images",
        "dataset.size": "[336,224]",
        "dataset.intrinsics": "estimate",
        "prior": "multiview_stereo",
        "graph": "up_to_scale",
    }
    first, second = capsys.readouterr().out.splitlines()
    assert all(word in first for word in words) and second.startswith(
        "5 images, at 336×224: about 1 min on this machine"
    )
    check_arguments("config", words)
    assert compose(*words).dataset.root == str(video)


def test_a_long_video_is_thinned_to_about_150_images_which_a_line_says_beforehand(tmp_path, capsys):
    """A minute of 30 images a second was mapped whole: hours, without a word."""
    path = tmp_path / "minute.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (32, 32))
    for row in range(900):
        writer.write(np.full((32, 32, 3), row % 256, np.uint8))
    writer.release()

    def stride_of(*given):
        return keys_of(with_source([str(path), *given])).get("dataset.stride")

    assert stride_of() == "6" and "150 of 900 images, every 6th" in capsys.readouterr().out
    assert stride_of("dataset.start=300") == "4" and stride_of("dataset.stop=200") is None
    assert stride_of("dataset.stride=9") == "9" and stride_of("prior=files") is stride_of("prior/dense=files") is None
    assert "100 of 900 images, every 9th" in capsys.readouterr().out


def test_a_folders_camera_is_calibrated_whatever_its_exif_says(tmp_path):
    plain, known = write_images(tmp_path / "plain"), write_images(tmp_path / "known", 26)
    assert keys_of(with_source([str(plain)]))["dataset.intrinsics"] == "estimate"
    found = keys_of(with_source([str(known), "slam.window_size=4"]))
    assert found["dataset.intrinsics"] == "estimate" and found["dataset.size"] == "[208,368]"
    assert found["slam.window_size"] == "4"


def test_keys_that_are_given_win(video):
    given = ["dataset.intrinsics=[90,90,48,32]", "dataset.size=[64,48]", "graph=none", "dataset.stride=2"]
    found = with_source([*given, str(video)])
    assert sorted(word for word in found if word in given) == sorted(given) and len(keys_of(found)) == len(found) == 7
    # Another prior may have a unit, another data set its own calibration, and a baseline does without a back end.
    assert not {"prior", "graph"} & {word.partition("=")[0] for word in with_source([str(video), "prior=files"])[:-1]}
    assert with_source([str(video), "dataset=tum"])[1:] == ["dataset=tum"]
    assert "graph" not in keys_of(with_source([str(video), "baseline=voxel"]))


def test_predictions_that_hold_a_camera_are_not_given_another(video, tmp_path):
    for row in range(5):
        arrays = {"depth": np.ones((32, 48)), "T_world_camera": np.eye(4), "intrinsics": [40.0, 41.0, 23.5, 15.5]}
        np.savez(tmp_path / f"{row}.npz", **arrays)
    words = [str(video), "prior=files", f"prior.folder={tmp_path}"]
    assert keys_of(with_source(words))["dataset.intrinsics"] == "[80,82,47.5,31.5]"
    own = with_source([*words, "dataset.intrinsics=estimate"])
    assert keys_of(own)["dataset.intrinsics"] == "estimate"
    for other in ({"depth": np.ones((48, 48))}, {"intrinsics": None}):  # of other images, and without a camera
        held = {key: value for key, value in (arrays | other).items() if value is not None}
        for row in range(5):
            np.savez(tmp_path / f"{row}.npz", **held)
        assert keys_of(with_source(words))["dataset.intrinsics"] == "estimate"


def test_what_is_no_path_is_left_alone():
    for words in (["--cfg", "job", "prior=recorded"], ["-m", "slam.em.noise=0,1"], ["~graph"], []):
        assert with_source(words) == words


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere.mp4"], r"nowhere.mp4 is no file or folder, and no key=value: emgs run --help"),
        (["a", "b"], "a, b: give one video"),
    ],
)
def test_a_word_that_leads_nowhere_is_one_clear_error(words, message):
    with pytest.raises(ValueError, match=message):
        with_source(words)


def test_a_folder_without_images_is_a_clear_error(tmp_path):
    with pytest.raises(ValueError, match=r"or a video file .* has no images"):
        with_source([str(tmp_path)])


@pytest.mark.parametrize("size", [(640, 480), (1920, 1080), (1080, 1920), (4032, 3024), (50, 2000)])
def test_frames_keep_the_shape_of_the_image_and_have_as_many_pixels_as_those_of_the_data_sets(size):
    width, height = about_pixels(*size)
    assert width % 16 == height % 16 == 0
    rounding = (8 / np.array([width, height])).sum() * 1.2  # of both sides to the next multiple, in a logarithm
    assert abs(np.log(width / height * size[1] / size[0])) <= rounding
    assert abs(np.log(width * height / (320 * 240))) <= rounding
    assert size != (4032, 3024) or (width, height) == (320, 240)


def test_a_camera_that_is_calibrated_is_mapped_while_it_runs(capsys):
    known = "dataset.intrinsics=[90,90,48,32]"
    found = keys_of(with_source(["camera:1", known]))
    assert found["prior.structure.online"] == "true" and found["prior"] == "multiview_stereo"
    assert found["dataset.intrinsics"] == "[90,90,48,32]" and not {"dataset.fps", "dataset.record"} & {*found}
    assert "while" not in capsys.readouterr().out
    for words in ([], ["dataset.intrinsics=estimate"], [known, "prior.structure.online=false"]):
        found = keys_of(with_source(["camera:1", *words]))
        assert found["dataset.record"] == "true" and found.get("prior.structure.online") != "true", words
        assert "they are mapped while they come" in capsys.readouterr().out
    assert not {"prior.structure.online", "dataset.record"} & {*keys_of(with_source(["camera", "prior=stream"]))}

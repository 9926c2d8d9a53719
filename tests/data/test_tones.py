"""Images of more than 8 bits; oracle: the 8 bits from which they were made."""

import cv2
import numpy as np
import pytest
from written_scene import color_image

from emgs_jax.data.images import Images
from emgs_jax.data.posed_images import Colmap
from emgs_jax.data.tones import MAX_LOOKED_AT, Tones, find_tones
from emgs_jax.data.tum import Tum

SIZE, INTRINSICS = (160, 120), (128.0, 128.0, 79.5, 59.5)


def write(folder, convert, count=3):
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        cv2.imwrite(str(folder / f"{i}.png"), convert(color_image(i, SIZE)))
    return folder


def loaded(folder):
    return Images(str(folder), size=SIZE, intrinsics=INTRINSICS)


@pytest.mark.parametrize("bits", [10, 12, 14])
@pytest.mark.parametrize("is_gray", [True, False])
def test_images_that_fill_some_of_16_bits_are_stretched_all_alike_and_a_note_says_so(bits, is_gray, tmp_path):
    def convert(image):
        return (image[..., 1] if is_gray else image).astype(np.uint16) << (bits - 8)

    dataset = loaded(write(tmp_path / "images", convert))
    brightest = 119 if is_gray else color_image(2, SIZE).max()
    for index in range(3):
        true = color_image(index, SIZE)[..., ::-1].astype(float)
        true = np.repeat(true[..., 1:2], 3, -1) if is_gray else true
        np.testing.assert_allclose(dataset[index].image, true * 255 / brightest, atol=4)
    assert "images have more than 8 bits: their values from 0 to" in dataset.calibration["note"]
    other = loaded(write(tmp_path / "other", lambda image: convert(image) // 2))
    assert other.fingerprint() != dataset.fingerprint()


def test_a_thermal_image_in_a_narrow_band_keeps_its_contrast(tmp_path):
    """Centikelvins: 21000 to 21000 + 119 are 82 to 82 in their upper 8 bits."""
    image = loaded(write(tmp_path / "t", lambda image: 21000 + image[..., 1].astype(np.uint16)))[0].image
    assert image.min() == 0 and image.max() == 255 and len(np.unique(image)) > 100


def test_8_bits_and_all_of_16_stay_as_they_are(tmp_path):
    eight = loaded(write(tmp_path / "8", lambda image: image))
    assert "note" not in eight.calibration
    np.testing.assert_array_equal(eight[1].image, color_image(1, SIZE)[..., ::-1])
    full = loaded(write(tmp_path / "16", lambda image: image.astype(np.uint16) * 514))
    assert "note" not in full.calibration
    np.testing.assert_allclose(full[1].image, color_image(1, SIZE)[..., ::-1] * 2.0, atol=1)


@pytest.mark.parametrize("deep", [0, 7, 19])
def test_one_image_of_more_bits_among_others_is_as_bright_as_they_are(deep, tmp_path):
    """It was an almost black one, and where it was looked at first nothing was said of the others."""
    write(tmp_path, lambda image: image, 20)
    cv2.imwrite(str(tmp_path / f"{deep}.png"), color_image(deep, SIZE).astype(np.uint16) << 4)
    dataset = loaded(tmp_path)
    assert dataset[deep].image.max() > 100 and "more than 8 bits" in dataset.calibration["note"]
    np.testing.assert_array_equal(dataset[1].image, color_image(1, SIZE)[..., ::-1])


def test_other_data_sets_show_them_likewise(tum_root, tmp_path):
    (folder,) = tum_root.iterdir()
    for path in (folder / "rgb").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path)).astype(np.uint16) * 16)
    dataset = Tum(str(tum_root), folder.name, stride=1)
    assert dataset[0].image.max() > 100 and "more than 8 bits" in dataset.calibration["note"]
    write(tmp_path / "project" / "images", lambda image: image.astype(np.uint16) * 16)
    (tmp_path / "project" / "cameras.txt").write_text("1 PINHOLE 160 120 128 128 80 60\n")
    (tmp_path / "project" / "images.txt").write_text("".join(f"{i + 1} 1 0 0 0 0 0 0 1 {i}.png\n\n" for i in range(3)))
    colmap = Colmap(str(tmp_path / "project"), size=SIZE)
    assert colmap[0].image.max() > 100 and "more than 8 bits" in colmap.calibration["note"]


def test_few_images_are_looked_at_and_one_value_is_no_error():
    seen = []

    def read(row):
        seen.append(row)
        return np.full((4, 4, 3), 800, np.uint16)

    tones = find_tones(read, 1000)
    assert len(seen) == MAX_LOOKED_AT and {0, 999} <= {*seen}
    assert tones.shown(read(0)).max() <= 255 and find_tones(read, 0) is None
    assert Tones(0.0, 1.0).shown(np.array([[np.nan, 0.5, 2.0]])).tolist() == [[0, 128, 255]]

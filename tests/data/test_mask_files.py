"""Whose mask is it? Oracle: images show a red block that moves, which the mask of each leaves out, and nothing else.

Right, whatever the data set, its frames in use, their size and lens: every frame has the mask of its own image, which
covers what it covers there. Two ways say whose a mask is: its name (and its folders, where names repeat), and for a
video its frame's number from 0, whatever `start` and `stride`. A mask may be of another size, and of the pixels as they
are stored where EXIF turns the image. What says neither, or says it of two images, is refused.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from emgs_jax.data.base import BadFrameError
from emgs_jax.data.images import Images
from emgs_jax.data.masks import Masks
from emgs_jax.data.posed_images import Colmap, Nerfstudio
from emgs_jax.data.readable import ReadableFrames

WIDTH, HEIGHT, COUNT = 160, 120, 12
PINHOLE = (130.0, 130.0, 79.5, 59.5)
LENS = (*PINHOLE, -0.3, 0.1, 0.0, 0.0)  # bends the border by ten pixels


def block(row: int) -> np.ndarray:
    """Where image `row` is red, bool (h, w)."""
    v, u = np.indices((HEIGHT, WIDTH))
    return (v >= 8) & (v < 72) & (u >= 10 * row + 4) & (u < 10 * row + 40)


def picture(row: int) -> np.ndarray:
    """RGB image of a row: grey but for its block."""
    return np.where(block(row)[..., None], np.uint8([255, 0, 0]), np.uint8(90))


def write(path: Path, image: np.ndarray, orientation: int = 1) -> str:
    """An image that viewers show as it is here, whatever its pixels on disk are."""
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored = np.rot90(image, {1: 0, 3: 2, 6: 1, 8: 3}[orientation])
    Image.fromarray(np.ascontiguousarray(stored)).save(
        path, **({"exif": exif, "quality": 98} if orientation > 1 else {})
    )
    return str(path)


def mask_of(row: int, scale: float = 1.0) -> np.ndarray:
    image = np.uint8(255 * ~block(row))
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)


def photos(
    root: Path, masks: Path, scale: float = 1.0, name: str = "IMG {}", more: str = "", orientation: int = 1, **k
):
    suffix = "png" if orientation == 1 else "jpg"
    for row in range(COUNT):
        write(root / f"{name.format(row)}.{suffix}", picture(row), orientation)
        write(masks / f"{name.format(row)}{more}.png", mask_of(row, scale))
    return Images(str(root), **{"intrinsics": PINHOLE} | k)


def photos_on_their_side(root: Path, masks: Path, orientation: int, **keys) -> Images:
    """The masks are of the pixels as they are stored, as programs that know no EXIF make them."""
    data = photos(root, masks, orientation=orientation, **keys)
    for row in range(COUNT):
        write(masks / f"IMG {row}.png", np.rot90(mask_of(row), {6: 1, 8: 3}[orientation]))
    return data


def video(root: Path, masks: Path, **keys) -> Images:
    root.mkdir()
    writer = cv2.VideoWriter(str(root / "a.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10, (WIDTH, HEIGHT))
    for row in range(COUNT):
        writer.write(np.ascontiguousarray(picture(row)[..., ::-1]))
        write(masks / f"{row:06d}.png", mask_of(row))
    writer.release()
    return Images(str(root / "a.mp4"), **{"intrinsics": PINHOLE} | keys)


def nerfstudio(
    root: Path,
    masks: Path | None,
    lens: dict[str, float] | None = None,
    name: str = "images/{:04d}.png",
    orientation: int = 1,
    **keys,
) -> Nerfstudio:
    """With `mask_path` where no folder is given; every third frame has none.

    With an `orientation` its pixels are as here, and programs that know EXIF would turn them.
    """
    frames = []
    for row in range(COUNT):
        path = root / name.format(row // 2 if "side" in name else row, side=("a", "b")[row % 2])
        write(path, picture(row))
        if orientation > 1:
            exif = Image.Exif()
            exif[0x0112] = orientation
            Image.fromarray(picture(row)).save(path, exif=exif, quality=98)
        own = path.relative_to(root)
        frames.append({"file_path": own.as_posix(), "transform_matrix": np.eye(4).tolist()})
        if masks is not None:
            write(masks / own.relative_to("images").with_suffix(".png"), mask_of(row))
        elif row % 3:
            write(root / f"own/m{row}.png", mask_of(row))
            frames[-1]["mask_path"] = f"own/m{row}.png"
    fx, fy, cx, cy = PINHOLE
    camera = {"fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5, "w": WIDTH, "h": HEIGHT, "camera_model": "OPENCV"}
    (root / "transforms.json").write_text(json.dumps(camera | (lens or {}) | {"frames": frames}))
    return Nerfstudio(str(root), **keys)


def colmap(root: Path, masks: Path, lens: Sequence[float] = (), orientation: int = 1, **keys) -> Colmap:
    """Two folders of images with the same names; pixels are as here whatever the `orientation`."""
    names = [f"{side}/{row:03d}.png" for row in range(COUNT // 2) for side in ("left", "right")]
    (root / "sparse/0").mkdir(parents=True)
    fx, fy, cx, cy = PINHOLE
    camera = f"{'OPENCV' if lens else 'PINHOLE'} {WIDTH} {HEIGHT} {fx} {fy} {cx + 0.5} {cy + 0.5}"
    (root / "sparse/0/cameras.txt").write_text(" ".join(map(str, (1, camera, *lens))) + "\n")
    lines = []
    for row, name in enumerate(names):
        write(root / "images" / name, picture(row))
        if orientation > 1:
            exif = Image.Exif()
            exif[0x0112] = orientation
            Image.fromarray(picture(row)).save(root / "images" / name, exif=exif)
        write(masks / f"{name}.png", mask_of(row))
        lines += [f"{row + 1} 1 0 0 0 {row} 0 0 1 {name}", ""]
    (root / "sparse/0/images.txt").write_text("\n".join(lines) + "\n")
    return Colmap(str(root), **keys)


CASES = {
    "photos": lambda r, m: photos(r, m),
    "photos, every third": lambda r, m: photos(r, m, start=1, stride=3),
    "photos, masks half as large": lambda r, m: photos(r, m, scale=0.5),
    "photos, masks twice as large": lambda r, m: photos(r, m, scale=2),
    "photos, frames of another shape": lambda r, m: photos(r, m, size=(128, 128)),
    "photos, IMAGE.png.png": lambda r, m: photos(r, m, more=".png"),
    "photos through a lens": lambda r, m: photos(r, m, intrinsics=LENS),
    "photos that EXIF turns": lambda r, m: photos(r, m, orientation=6),
    "photos that EXIF turns to the right": lambda r, m: photos_on_their_side(r, m, 6),
    "photos that EXIF turns to the left": lambda r, m: photos_on_their_side(r, m, 8),
    "video": lambda r, m: video(r, m),
    "video, every third": lambda r, m: video(r, m, stride=3),
    "video, from the fifth": lambda r, m: video(r, m, start=5, stop=9),
    "video through a lens": lambda r, m: video(r, m, intrinsics=LENS, stride=2),
    "video, frames of another shape": lambda r, m: video(r, m, size=(96, 128), start=2),
    "nerfstudio": lambda r, m: nerfstudio(r, m, stride=2),
    "nerfstudio, from the third": lambda r, m: nerfstudio(r, m, start=3, stop=9),
    "nerfstudio, frames of another shape": lambda r, m: nerfstudio(r, m, size=(128, 128)),
    "nerfstudio, two folders": lambda r, m: nerfstudio(r, m, name="images/{side}/{:03d}.png", start=1),
    "nerfstudio, EXIF that nobody heeds": lambda r, m: nerfstudio(r, m, name="images/{:04d}.jpg", orientation=3),
    "nerfstudio through a lens": lambda r, m: nerfstudio(r, m, {"k1": -0.3, "k2": 0.1}),
    "COLMAP": lambda r, m: colmap(r, m),
    "COLMAP, every fifth": lambda r, m: colmap(r, m, start=1, stride=5),
    "COLMAP, frames of another shape": lambda r, m: colmap(r, m, size=(128, 128)),
    "COLMAP through a lens": lambda r, m: colmap(r, m, LENS[4:], stride=2),
    "COLMAP, EXIF that nobody heeds": lambda r, m: colmap(r, m, orientation=3),
    "photos through a lens that EXIF turns": lambda r, m: photos_on_their_side(r, m, 6, intrinsics=LENS, stride=2),
}


def wrong(frame) -> float:
    """Share of the image that is red and used, or neither red nor used."""
    red, green, blue = frame.image.astype(int).transpose(2, 0, 1)
    return float(np.mean((red - (green + blue) / 2 > 80) != frame.mask))


@pytest.mark.parametrize("kind", CASES)
def test_each_frame_has_its_own_mask(tmp_path, kind):
    data = CASES[kind](tmp_path / "data", tmp_path / "masks")
    frames = ReadableFrames(data, masks=Masks(str(tmp_path / "masks"), border=0))
    assert frames.has_masks and len(frames) >= 3
    assert max(map(wrong, frames)) < 0.02  # an edge of a pixel; the next frame's mask is off by .09
    full = frames.full(0), frames.full_mask(0)
    assert full[0].shape[:2] == full[1].shape
    assert abs(full[1].mean() - frames[0].mask.mean()) < 0.02


def test_masks_of_nerfstudio_count_where_no_others_are_given(tmp_path):
    frames = ReadableFrames(nerfstudio(tmp_path / "data", None, stride=2), masks=Masks(border=0))
    assert [frame.mask is not None for frame in frames] == [row % 3 > 0 for row in range(0, COUNT, 2)]
    assert max(wrong(frame) for frame in frames if frame.mask is not None) < 0.02
    other = tmp_path / "other"
    for row in range(COUNT):
        write(other / f"{row:04d}.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    chosen = ReadableFrames(Nerfstudio(str(tmp_path / "data")), masks=Masks(str(other)))
    assert not any(frame.mask.any() for frame in chosen)


def test_a_run_is_of_the_contents_of_its_masks_and_an_empty_path_is_none(tmp_path):
    data = nerfstudio(tmp_path / "data", None)
    before = ReadableFrames(data).fingerprint()
    write(tmp_path / "data/own/m1.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    assert ReadableFrames(data).fingerprint() != before
    path = tmp_path / "data/transforms.json"
    path.write_text(path.read_text().replace("own/m1.png", "").replace("own/m2.png", "own\\\\m2.png"))
    frames = ReadableFrames(Nerfstudio(str(tmp_path / "data")))
    assert frames[1].mask is None and frames[2].mask.any()


def test_a_mask_of_the_upright_image_is_refused_where_images_are_taken_as_they_are_stored(tmp_path):
    """Symptom: it was turned by 180 degrees and taken."""
    data, root = nerfstudio(tmp_path / "data", tmp_path / "masks"), tmp_path / "data"
    for row in range(COUNT):
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.fromarray(picture(row)).save(root / f"images/{row:04d}.png", exif=exif)
        write(tmp_path / f"masks/{row:04d}.png", np.rot90(mask_of(row), 3))
    with pytest.raises(BadFrameError, match="it is turned: make it of that size"):
        ReadableFrames(data, masks=Masks(str(tmp_path / "masks")))


def test_masks_that_are_those_of_other_frames_are_refused(tmp_path):
    (data, masks), flat = (tmp_path / "v", tmp_path / "m"), tmp_path / "flat"
    walk = video(data, masks, start=2, stop=8)
    for row in reversed(range(COUNT)):  # as ffmpeg numbers them
        (masks / f"{row:06d}.png").rename(masks / f"{row + 1:06d}.png")
    with pytest.raises(ValueError, match="masks from 1 on, and frames of a video are numbered from 0"):
        ReadableFrames(walk, masks=Masks(str(masks)))
    both = colmap(tmp_path / "c", tmp_path / "folders")
    for row in range(COUNT // 2):
        write(flat / f"{row:03d}.png", mask_of(row))
    with pytest.raises(ValueError, match="is the mask of 2 images: put masks into folders"):
        ReadableFrames(both, masks=Masks(str(flat)))


def test_an_image_that_cannot_be_read_needs_no_mask_where_it_is_skipped(tmp_path):
    """Symptom: `on_bad_frame=skip` ended for want of the mask of an image that it skips."""
    data = photos(tmp_path / "data", tmp_path / "masks")
    (tmp_path / "data/IMG 3.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (tmp_path / "masks/IMG 3.png").unlink()
    frames = ReadableFrames(data, "skip", masks=Masks(str(tmp_path / "masks"), border=0))
    assert [*frames.skipped] == [3] and len(frames) == COUNT - 1 and max(map(wrong, frames)) < 0.02
    (tmp_path / "masks/IMG 5.png").unlink()
    with pytest.raises(ValueError, match="has no mask for IMG 5 .and 0 more."):
        ReadableFrames(data, "skip", masks=Masks(str(tmp_path / "masks")))


def test_masks_that_leave_out_most_are_said(tmp_path):
    data = photos(tmp_path / "data", tmp_path / "masks")
    assert (
        ReadableFrames(data, masks=Masks(str(tmp_path / "masks"))).mask_note
        == "masks of 12 of 12 frames leave out 13 % of the images"
    )
    for row in range(COUNT):
        write(tmp_path / f"masks/IMG {row}.png", ~mask_of(row))
    note = ReadableFrames(data, masks=Masks(str(tmp_path / "masks"))).mask_note
    assert "89 % of the images; black is left out, white is kept" in note


KINDS = {
    "255": lambda kept: Image.fromarray(np.uint8(255 * kept)),
    "1": lambda kept: Image.fromarray(np.uint8(kept)),
    "one bit": lambda kept: Image.fromarray(np.uint8(255 * kept)).convert("1", dither=0),
    "16 bits, 65535": lambda kept: Image.fromarray(np.uint16(65535 * kept)),
    "16 bits, 1": lambda kept: Image.fromarray(np.uint16(kept)),
    "RGB": lambda kept: Image.fromarray(np.uint8(255 * kept)).convert("RGB"),
    "JPEG": lambda kept: Image.fromarray(np.uint8(255 * kept)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_mask_is_read_as_programs_write_it_and_what_is_no_image_is_left(tmp_path, kind):
    KINDS[kind](~block(3)).save(tmp_path / f"a.{'jpg' if kind == 'JPEG' else 'png'}")
    (tmp_path / "a.txt").write_text("0 .5 .5 .2 .8\n")
    masks = Masks(str(tmp_path), border=0)
    found = masks.decoded(*masks.files([Path("x/a.png")], [0]), (WIDTH, HEIGHT))
    assert np.mean(found != block(3)) <= (0.03 if kind == "JPEG" else 0)


@pytest.mark.parametrize(("orientation", "is_said"), [(1, False), (6, False), (3, True)])
def test_where_the_sides_of_a_mask_do_not_tell_a_turn_it_is_said_how_masks_are_taken(tmp_path, orientation, is_said):
    """An image that is upside down has the sides of one that is not: its mask was taken for either without a word."""
    data = photos(tmp_path / "images", tmp_path / "masks", orientation=orientation)
    note = ReadableFrames(data, masks=Masks(str(tmp_path / "masks"))).mask_note
    assert ("masks are taken as of the image as it is shown" in note) == is_said

"""COLMAP on rendered images against the truth; what is kept, begun anew and refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from stereo_scene import room, shots, similarity_error, structure_config

from emgs_jax.structure import store
from emgs_jax.structure.model import NONE, to_structure
from emgs_jax.structure.reconstruct import map_images
from emgs_jax.structure.store import make_models

NOISE = np.random.default_rng(0).integers(0, 255, (8, 120, 160, 3), np.uint8)
pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def cache_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "CACHE", tmp_path / "cache")


@pytest.fixture(scope="module")
def images():
    return [frame.image for frame in room()]


def made(images, folder, *words, **more):
    """The structure of images, kept in a folder."""
    config, taken = structure_config(*words), shots(images, **more)
    files = [Path(f"{name}.png") for name in taken.names]
    taken = taken._replace(mask=config.masks.reader(files, range(len(files)), taken.size))
    _, models = make_models(taken, config, folder)
    return to_structure(models, taken.names, config)


def same(one, other):
    for name in ("world", "T_world_camera", "covariance"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    for a, b in zip((*one.worlds, *one.landmarks), (*other.worlds, *other.landmarks), strict=True):
        np.testing.assert_array_equal(getattr(a, "points", a), getattr(b, "points", b))


@pytest.fixture
def counted(monkeypatch):
    """Calls of COLMAP."""
    calls = []
    monkeypatch.setattr(store, "map_images", lambda *given: calls.append(1) or map_images(*given))
    return calls


def test_poses_and_depths_are_the_true_ones_up_to_one_scale_and_are_not_made_twice(tmp_path, images, counted, capfd):
    found = made(images, tmp_path / "structure")
    T_true = np.stack([frame.T_world_camera for frame in room()])
    estimate, truth = found.T_world_camera[:, :3, 3], T_true[:, :3, 3]
    assert similarity_error(estimate, truth) < 0.015  # m, of a path of .56 m, at 160 pixels
    scale = np.linalg.norm(truth[-1] - truth[0]) / np.linalg.norm(estimate[-1] - estimate[0])
    camera = found.worlds[0].camera
    for frame in range(8):
        local = (found.shown(frame) - estimate[frame]) @ found.T_world_camera[frame, :3, :3]
        x, y = np.rint(camera.img_from_cam(local) - 0.5).astype(int).T.clip(0, [[159], [119]])
        error = np.abs(scale * found.depths(frame) / room()[frame].depth[y, x] - 1)
        assert len(error) > 100 and np.median(error) < 0.05, frame  # the two ends give the scale to 3 %
    assert np.median(np.concatenate([found.depths(frame) for frame in range(8)])) == pytest.approx(2.0)
    same(made(images, tmp_path / "structure"), found)  # from the run's folder
    same(made(images, tmp_path / "other"), found)  # from the cache
    assert len(counted) == 1 and not list(tmp_path.glob(".structure*"))
    said = capfd.readouterr()
    assert "cc:" not in said.out + said.err and "[ WARN" not in said.err


def test_another_setting_in_the_same_folder_leaves_nothing_of_the_one_before(tmp_path, images, counted):
    """Symptom: of two models in the folder, the second stayed beside the new one and was read as one of its own."""
    made(images, tmp_path / "structure")
    (tmp_path / "structure/0").rename(tmp_path / "structure/7")
    other = made(images, tmp_path / "structure", "prior.structure.seed=1")
    assert len(counted) == 2 and len(other.worlds) == 1
    assert [path.name for path in sorted((tmp_path / "structure").iterdir())] == ["0", "structure.json"]
    again = made(images, tmp_path / "elsewhere", "prior.structure.seed=1")
    store.shutil.rmtree(tmp_path / "cache")
    same(made(images, tmp_path / "a_third", "prior.structure.seed=1"), again)
    assert len(counted) == 3, "made anew, with the same bits"


def test_what_was_found_before_a_call_was_interrupted_is_gone_on_with(tmp_path, images):
    config, taken, read = structure_config(), shots(images), []

    def interrupted(index):
        if len(read) == 8:
            raise KeyboardInterrupt
        read.append(index)
        return images[index]

    twelve = taken._replace(names=[*taken.names, "a", "b"], read=interrupted)
    with pytest.raises(KeyboardInterrupt):
        map_images(twelve, config, tmp_path)
    read.clear()
    models, *_ = map_images(
        twelve._replace(read=lambda index: read.append(index) or images[index % 8]), config, tmp_path
    )
    assert read == [8, 9] and models[0].num_reg_images() >= 8


def test_frames_that_show_nothing_or_cannot_be_read_have_no_pose(tmp_path, images):
    blank, other_size = np.full_like(images[0], 128), images[6][:90]
    found = made([None, *images[1:3], blank, images[4], None, other_size, images[7]], tmp_path / "structure")
    is_there = np.array([frame in (1, 2, 4, 7) for frame in range(8)])
    np.testing.assert_array_equal(found.world, np.where(is_there, 0, NONE))
    assert np.isnan(found.T_world_camera[~is_there]).all() and np.isnan(found.covariance[~is_there]).all()
    assert np.isfinite(found.covariance[is_there]).all()
    assert [len(shown) > 0 for shown in found.landmarks] == is_there.tolist()


def test_nothing_is_looked_for_where_a_mask_is_black(tmp_path, images):
    """The left half."""
    names, masks = [f"my_photo_{row}" for row in range(8)], tmp_path / "masks"
    masks.mkdir()
    for name in names:
        cv2.imwrite(str(masks / f"{name}.png"), np.uint8(255 * (np.indices((120, 160))[1] >= 80)))
    found = made(images, tmp_path / "structure", f"masks.folder={masks}", "masks.border=0", names=names)
    assert (found.world == 0).all()
    for frame in range(8):
        local = (found.shown(frame) - found.T_world_camera[frame, :3, 3]) @ found.T_world_camera[frame, :3, :3]
        assert found.worlds[0].camera.img_from_cam(local)[:, 0].min() > 75


def turned(count):
    """Images of a texture at infinity, by a camera that only turns."""
    texture = cv2.GaussianBlur(np.repeat(np.repeat(NOISE[0], 5, 0), 5, 1), (0, 0), 2)
    v, u = np.indices((120, 160), np.float32)
    rays = np.stack([(u - 79.5) / 131.2, (v - 59.5) / 131.2, np.ones_like(u)], axis=-1)
    found = []
    for row in range(count):
        x, y, z = np.moveaxis(rays @ cv2.Rodrigues(np.array([0, 0.05 * row, 0.01 * row]))[0].T, -1, 0)
        angle, height = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
        found.append(
            cv2.remap(texture, np.float32(400 * angle + 350), np.float32(400 * height + 300), cv2.INTER_LINEAR)
        )
    return found


BAD = {
    "two images": (lambda images: images[:2], (), "2 images are too few: give 3 or more of one place .dataset.stop"),
    "one repeated": (lambda images: images[:1] * 6, (), "move the camera sideways"),
    "a rotation": (lambda images: turned(5), (), "pairs of images differ by a rotation or show one plane"),
    "blank": (lambda images: [np.full_like(images[0], 9)] * 4, (), "4 of 4 images show hardly anything"),
    "noise": (lambda images: [*NOISE[:4]], (), "no two images share enough: take them closer together"),
    "no mask": (lambda images: images, ("masks.folder=nowhere",), "has no mask for 000 .and 7 more"),
    "features": (lambda images: images, ("prior.structure.features=surf",), "features=surf is unknown: .* sift"),
    "matcher": (lambda images: images, ("prior.structure.matcher=x",), "matcher=x is unknown: .* sift_bruteforce"),
    "a network": (lambda images: images, ("prior.structure.features=aliked_n32",), "ONNX.*use features=sift"),
    "an option": (
        lambda images: images,
        ("+prior.structure.options.extraction.nope=1",),
        "options: .*nope.*its options are .*max_image_size",
    ),
    "a value": (
        lambda images: images,
        ("+prior.structure.options.incremental.min_model_size=-5",),
        "'min_model_size': -5.*out of its range",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_determines_no_structure_is_one_error_with_its_remedy(tmp_path, images, case):
    """Features that this pycolmap is not built for ended the whole process (SIGABRT)."""
    make, words, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        made(make(images), tmp_path / "structure", *words)


def test_masks_that_hide_all_are_named_and_one_of_another_size(tmp_path, images):
    for shape, message in (
        ((120, 160), "hardly anything to recognise.*masks.folder"),
        ((9, 9), "is 9x9, but"),
    ):
        for row in range(4):
            cv2.imwrite(str(tmp_path / f"{row:03d}.png"), np.zeros(shape, np.uint8))
        with pytest.raises(ValueError, match=message):
            made(images[:4], tmp_path / "structure", f"masks.folder={tmp_path}")


def test_a_folder_that_cannot_be_written_is_done_without(tmp_path, images, monkeypatch, capsys):
    (tmp_path / "file").touch()
    monkeypatch.setattr(store, "CACHE", tmp_path / "file" / "cache")
    kept = made(images, tmp_path / "structure")
    assert "the next run makes it again" in "".join(capsys.readouterr())
    monkeypatch.setattr(store, "CACHE", tmp_path / "cache")
    same(made(images, tmp_path / "file" / "structure"), kept)

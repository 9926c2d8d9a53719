"""Class images: ids by the file of names, positions in it, and what is wrong with each kind of bad file."""

import cv2
import numpy as np
import pytest
from written_scene import scene_pose

from emgs_jax.data.base import BadFrameError
from emgs_jax.data.labels import LabelFolder
from emgs_jax.data.tum import Tum

SEQUENCE = "rgbd_dataset_freiburg3_plane"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "semantic").mkdir()
    (tmp_path / "classes.txt").write_text("# id name\n7 sofa\n3 wall plug\n300 wall\n")
    ids = np.array([[7, 3, 0], [300, 300, 7]], np.uint16)
    cv2.imwrite(str(tmp_path / "semantic" / "0.5.png"), ids)
    return tmp_path


def labels_of(folder, **options):
    return LabelFolder(folder / "semantic", folder / "classes.txt", **options)


def test_ids_become_positions_among_the_names_and_names_alone_count_from_zero(folder):
    labels = labels_of(folder)
    assert labels.names == ("sofa", "wall plug", "wall")
    np.testing.assert_array_equal(labels.read("rgb/0.5.jpg", (3, 2)), [[0, 1, -1], [2, 2, 0]])
    with pytest.raises(BadFrameError, match=r"no name in .* for id 0"):
        labels_of(folder, unknown=()).read("0.5.jpg")
    # Ids that mean no class mean none also where they have a name.
    np.testing.assert_array_equal(labels_of(folder, unknown=(0, 7)).read("0.5.jpg"), [[-1, 1, -1], [2, 2, -1]])
    (folder / "classes.txt").write_text("wall\n3d printer\n\nold chair\n")
    cv2.imwrite(str(folder / "semantic" / "0.5.png"), np.array([[2, 0, 1]], np.uint8))
    labels = labels_of(folder, unknown=())
    assert labels.names == ("wall", "3d printer", "old chair")
    np.testing.assert_array_equal(labels.read("0.5.jpg"), [[2, 0, 1]])


@pytest.fixture
def labelled_root(tum_root):
    """The left third of each image is wall, the rest has no class, but for a row of cups."""
    sequence = tum_root / SEQUENCE
    (sequence / "semantic").mkdir()
    (sequence / "classes.txt").write_text("4 wall\n9 cup\n")
    ids = np.zeros((480, 640), np.uint8)
    ids[:, :200], ids[100] = 4, 9
    for image in (sequence / "rgb").iterdir():
        cv2.imwrite(str(sequence / "semantic" / f"{image.stem}.png"), ids)
    return tum_root


def test_a_sequence_in_the_tum_layout_may_have_true_classes(labelled_root):
    dataset = Tum(str(labelled_root), SEQUENCE, stride=1, size=(640, 480), labels="semantic")
    assert dataset.classes == ("wall", "cup")
    for index, frame in enumerate(dataset):
        assert frame.labels.dtype == np.int32 and frame.labels.shape == (480, 640)
        assert (frame.labels[100] == 1).all() and (frame.labels[101:, :200] == 0).all()
        assert (frame.labels[101:, 200:] == -1).all()
        np.testing.assert_allclose(frame.T_world_camera, scene_pose(index), atol=1e-6)
        assert labelled_root / SEQUENCE / "semantic" / f"{index + 100}.png" not in dataset.files(0)[:1]
    assert dataset.fingerprint() != Tum(str(labelled_root), SEQUENCE, stride=1, size=(640, 480)).fingerprint()
    assert Tum(str(labelled_root), SEQUENCE, stride=1)[0].labels is None
    # Barrel distortion: the straight image's corners come from beyond the border, where there is no class.
    options = {"intrinsics": [535.4, 539.2, 320.1, 247.6], "distortion": [0.2, 0, 0, 0, 0]}
    frame = Tum(str(labelled_root), SEQUENCE, stride=1, size=(640, 480), labels="semantic", **options)[0]
    assert set(np.unique(frame.labels)) == {-1, 0, 1}

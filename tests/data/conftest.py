"""Small sequences of a known scene, written once in every layout, and the real ones of the development slice."""

import shutil
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from written_benchmarks import write_euroc, write_kitti
from written_scene import moved, write_images, write_replica, write_seven_scenes, write_tum

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"


@pytest.fixture
def shared_data():
    """Path of a data set of the development slice; skips where the slice is not there."""

    def find(name: str) -> str:
        if not (SHARED / name).exists():
            pytest.skip(f"needs the development data {name}, which the repository does not ship")
        return str(SHARED / name)

    return find


@pytest.fixture(scope="session")
def written(tmp_path_factory):
    """Folder of a scene in the layout that a function writes."""

    @cache
    def folder(write) -> Path:
        root = tmp_path_factory.mktemp(write.__name__)
        write(root)
        return root

    return folder


def copy_of(write):
    """A fixture: the scene in a folder that the test may change."""

    @pytest.fixture
    def root(tmp_path, written) -> Path:
        return Path(shutil.copytree(written(write), tmp_path / write.__name__))

    return root


seven_scenes_root, tum_root, replica_root, images_root = map(
    copy_of, (write_seven_scenes, write_tum, write_replica, write_images)
)
euroc_root, kitti_root = map(copy_of, (write_euroc, write_kitti))


@pytest.fixture
def depth_gaps():
    """Depth that frame j has at the points of frame i, less the points' z; metres, positive = floats in front."""

    def measure(dataset, i: int, j: int, edge: float = 0.05) -> np.ndarray:
        b, (w, h) = dataset[j], dataset.size
        _, (column, row, z) = moved(dataset, i, j)
        column, row = np.rint(column).astype(int), np.rint(row).astype(int)
        # The image's gradient bounds what half a pixel of rounding can do: steps in depth are left out.
        steps = cv2.dilate(b.depth, np.ones((3, 3))) - cv2.erode(b.depth, np.ones((3, 3)))
        inside = (z > 0.1) & (column >= 0) & (column < w) & (row >= 0) & (row < h)
        column, row, z = column[inside], row[inside], z[inside]
        seen = (b.depth[row, column] > 0) & (steps[row, column] < edge)
        return (b.depth[row, column] - z)[seen]

    return measure


bonn_root = tum_root  # the same layout

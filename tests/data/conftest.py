"""Small sequences of a known scene, written once in every layout, and the real ones of the development slice."""

import json
import shutil
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from written_scene import color_image, moved, plane_depth, scene_pose, write_depth

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"
NUM_FRAMES = 3


@pytest.fixture
def shared_data():
    """Path of a data set of the development slice; skips where the slice is not there."""

    def find(name: str) -> str:
        if not (SHARED / name).exists():
            pytest.skip(f"needs the development data {name}, which the repository does not ship")
        return str(SHARED / name)

    return find


def write_seven_scenes(root: Path) -> None:
    folder = root / "kitchen" / "seq-01"
    folder.mkdir(parents=True)
    for i in range(NUM_FRAMES):
        depth = plane_depth(scene_pose(i), (585, 585, 320, 240), (640, 480))
        write_depth(folder / f"frame-{i:06d}.depth.png", depth, 1000)
        cv2.imwrite(str(folder / f"frame-{i:06d}.color.{'jpg' if i else 'png'}"), color_image(i, (640, 480)))
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", scene_pose(i))


def write_tum(root: Path) -> None:
    folder = root / "rgbd_dataset_freiburg3_plane"
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    lists = {"rgb": "# color\n", "depth": "# depth\n", "groundtruth": "# t tx ty tz qx qy qz qw\n"}
    for i in range(NUM_FRAMES):
        time = 100.0 + i
        cv2.imwrite(str(folder / "rgb" / f"{time:.6f}.png"), color_image(i, (640, 480)))
        depth = plane_depth(scene_pose(i), (535.4, 539.2, 320.1, 247.6), (640, 480))
        write_depth(folder / "depth" / f"{time + 0.01:.6f}.png", depth, 5000)
        lists["rgb"] += f"{time:.6f} rgb/{time:.6f}.png\n"
        lists["depth"] += f"{time + 0.01:.6f} depth/{time + 0.01:.6f}.png\n"
        half = 0.05 * i / 2  # half of scene_pose's angle
        x, y, z = scene_pose(i)[:3, 3]
        lists["groundtruth"] += f"{time - 0.005:.4f} {x} {y} {z} 0 {np.sin(half)} 0 {np.cos(half)}\n"
    for name, text in lists.items():
        (folder / f"{name}.txt").write_text(text)


def write_replica(root: Path) -> None:
    folder = root / "office9" / "results"
    folder.mkdir(parents=True)
    camera = {"w": 120, "h": 68, "fx": 60.0, "fy": 60.0, "cx": 59.5, "cy": 33.5, "scale": 6553.5}
    (root / "cam_params.json").write_text(json.dumps({"camera": camera}))
    for i in range(NUM_FRAMES):
        cv2.imwrite(str(folder / f"frame{i:06d}.jpg"), color_image(i, (120, 68)))
        write_depth(folder / f"depth{i:06d}.png", plane_depth(scene_pose(i), (60, 60, 59.5, 33.5), (120, 68)), 6553.5)
    rows = [" ".join(f"{v:.9e}" for v in scene_pose(i).ravel()) for i in range(NUM_FRAMES)]
    (root / "office9" / "traj.txt").write_text("\n".join(rows))


def write_images(root: Path) -> None:
    for i, name in enumerate(("img2.png", "img10.JPG", "IMG33.jpeg")):
        cv2.imwrite(str(root / name), color_image(i, (160, 120)))


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
bonn_root = tum_root  # the same layout


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

"""The known scene that the tests write to disk: a slanted plane, seen from a camera that moves."""

import json
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

NUM_FRAMES = 3


def scene_pose(index: int) -> np.ndarray:
    """T_world_camera of frame `index`: a step aside and a turn about y."""
    angle = 0.05 * index
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = [0.04 * index, 0.01 * index, 0.02 * index]
    return pose


def plane_depth(pose: np.ndarray, intrinsics: tuple[float, ...], size: tuple[int, int]) -> np.ndarray:
    """Camera z in metres (h, w) of the world's plane .3 x - .2 y + z = 2, in closed form."""
    normal, (fx, fy, cx, cy) = np.array([0.3, -0.2, 1.0]), intrinsics
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], axis=-1) @ pose[:3, :3].T
    return (2.0 - normal @ pose[:3, 3]) / (rays @ normal)


def write_depth(path: Path, depth: np.ndarray, scale: float) -> None:
    """A 16-bit image of so many units a metre."""
    cv2.imwrite(str(path), np.rint(depth * scale).astype(np.uint16))


def color_image(index: int, size: tuple[int, int]) -> np.ndarray:
    """A smooth BGR image that names its frame by its mean."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return np.stack([u * 120 // size[0], v * 120 // size[1], np.full(u.shape, 40 * index + 20)], -1).astype(np.uint8)


def dots(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """An RGB image of soft white dots."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    spots = sum(np.exp(-((u - x) ** 2 + (v - y) ** 2) / 4) for x, y in pixels)
    return np.repeat(np.rint(255 * np.minimum(spots, 1))[..., None], 3, axis=-1).astype(np.uint8)


def center_of_dot(image: np.ndarray, near: tuple[float, float]) -> np.ndarray:
    u, v = np.meshgrid(np.arange(image.shape[1]), np.arange(image.shape[0]))
    weight = image[..., 0] * ((u - near[0]) ** 2 + (v - near[1]) ** 2 < 64.0)
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()


def moved(dataset, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (row, column) of frame i that have depth, and where frame j shows them: column, row and z."""
    a, (fx, fy, cx, cy) = dataset[i], dataset.intrinsics
    v, u = np.nonzero(a.depth > 0)
    z = a.depth[v, u].astype(np.float64)
    points = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z, np.ones_like(z)])
    x, y, z = (np.linalg.inv(dataset[j].T_world_camera) @ a.T_world_camera @ points)[:3]
    return np.stack([v, u]), np.stack([fx * x / z + cx, fy * y / z + cy, z])


def scalar_first(pose: np.ndarray) -> np.ndarray:
    """What a reader of x y z w makes of the pose's quaternion, written w x y z."""
    changed = pose.copy()
    w_x_y_z = Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]
    changed[:3, :3] = Rotation.from_quat(w_x_y_z).as_matrix()
    return changed


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

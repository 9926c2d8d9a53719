"""Plausible bugs that no operator makes (a unit, a frame, an order): `python -m tools.by_hand [em]` tries them.

Each is made in this tree, and taken back, while its file of tests runs, which must fail: start it in a tree of its own.
A survivor wants a test, or is no bug.
"""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# A file of emgs_jax, the bug, and its file of tests where that has another name; then the text and what replaces it.
BUGS = """
registration/pose_noise: metres for radians
  - jnp.append(mean_depth, 1.0), 3,
  + jnp.append(1.0, mean_depth), 3,
registration/problem: worse is worth more
  - worse = jnp.maximum(misfit / depth_noise, 1.0)
  + worse = jnp.maximum(depth_noise / misfit, 1.0)
registration/problem: rays stay in the camera's frame (registration/test_icp)
  - rays @ T.rotation().as_matrix().T
  + rays
pose_graph/deform: a view scaled about the world's origin
  - view, jnp.ones(())), motions.scale[row])
  + view, motions.scale[row]), jnp.ones(()))
localization: the newest pose without its scale
  - scale_translation(raw_current.inverse() @ raw_newest, unit)
  + raw_current.inverse() @ raw_newest
registration/pose_noise: each answer in its own unit
  - anchor @ previous]), scale)
  + anchor @ previous]), 1.0)
registration/pose_estimate: the errors stay in the axes of the camera before
  - A @ covariance @ A.T + 
  + covariance + 
mapping/tracking: the map's error stays in the axes of the camera that made it (mapping/test_covariance_of_map)
  - seen_from(there.covariance, there.pose, pose[None])[0]
  + there.covariance
observation: second moments about the pixel
  - xx - count * x**2
  + xx
gaussians: luminance as a plain mean
  - (0.299, 0.587, 0.114)
  + (0.333, 0.333, 0.333)
initialization: poses the wrong way round
  - transform(T, view, jnp.ones(()))
  + transform(T.inverse(), view, jnp.ones(()))
em: a covariance about the old mean
  - second - outer(mean[:, :3])
  + second
existence: all is seen from the world's origin
  - gaussians.means - origins
  + gaussians.means
back_end/factors: edges the other way round (back_end/test_back_end)
  - np.linalg.inv(poses[a]) @ poses[b], np.exp(-log_scales[a])
  + np.linalg.inv(poses[b]) @ poses[a], np.exp(-log_scales[a])
mapping/atlas: the unit of a place is that of the map after it has moved (mapping/test_covariance_of_map)
  - scale_covariance(place.covariance, 1.0 / unit)
  + scale_covariance(place.covariance, 1.0 / scale)
loop_closure/two_view_alignment: the reverse pose is brought into the wrong unit (loop_closure/test_verification)
  - scale_pose(np.linalg.inv(T_b_a), np.exp(log_ratio))
  + scale_pose(np.linalg.inv(T_b_a), np.exp(-log_ratio))
prior/simulated/noise: metres for radians (prior/simulated/test_simulated)
  - T[:3, :3] = Rotation.from_rotvec(rotation * 
  + T[:3, :3] = Rotation.from_rotvec(translation * 
back_end/g2o: quaternions are written with w first
  - [4, 5, 6, 1, 2, 3, 0]
  + [4, 5, 6, 0, 1, 2, 3]
io/trajectory: quaternions with w first are read (io/test_trajectory_file)
  - Rotation.from_quat(values[is_finite, 3:])
  + Rotation.from_quat(values[is_finite][:, [6, 3, 4, 5]])
io/ply: quaternions with w last
  - [:, [3, 0, 1, 2]]
  + [:, [0, 1, 2, 3]]
data/tones: BGR for RGB (data/test_images)
  - return cv2.cvtColor(image if tones is None else tones.shown(image), cv2.COLOR_BGR2RGB)
  + return image if tones is None else tones.shown(image)
data/seven_scenes: the colour camera on the other side
  - T_world_depth @ np.linalg.inv(T_COLOR_DEPTH) if is_moved
  + T_world_depth @ T_COLOR_DEPTH if is_moved
data/camera_models: COLMAP's corner taken for the centre of a pixel
  - found["cx"] - corner, found["cy"] - corner
  + found["cx"], found["cy"]
data/transforms_json: nerfstudio's axes are taken for OpenCV's (data/test_posed_images)
  - np.vstack([m, bottom])) * FLIP)
  + np.vstack([m, bottom])))
"""


def bugs() -> list[tuple[str, Path, Path, str, str]]:
    """Read `BUGS`: words, file, its tests, text before and after."""
    lines, found = BUGS.strip().splitlines(), []
    for head, before, after in zip(lines[::3], lines[1::3], lines[2::3], strict=True):
        name, words = head.split(": ", 1)
        tests = words.partition(" (")[2].rstrip(")") or str(Path(name).parent / f"test_{Path(name).name}")
        found.append((head, ROOT / f"emgs_jax/{name}.py", ROOT / f"tests/{tests}.py", before[4:], after[4:]))
    return found


def is_noticed(file: Path, tests: Path, before: str, after: str) -> bool:
    """Return whether the tests fail with the bug; the file is as it was afterwards."""
    source = file.read_text(encoding="utf-8")
    try:
        file.write_text(source.replace(before, after), encoding="utf-8")
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-m", "", tests]
        return subprocess.run(command, cwd=ROOT, capture_output=True).returncode == 1
    finally:
        file.write_text(source, encoding="utf-8")


if __name__ == "__main__":
    for words, *bug in bugs():
        if any(word in words for word in sys.argv[1:] or [""]):
            print("noticed " if is_noticed(*bug) else "SURVIVED", words, flush=True)

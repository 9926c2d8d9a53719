"""EuRoC MAV and other data in the ASL layout: one camera on a rig with known motion; no depth."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from emgs_jax.data import reading
from emgs_jax.data.calibration_files import Calibration, kalibr_camera, numbers_of, parse_keys
from emgs_jax.data.posed_images import Pose, PosedImages, Solved
from emgs_jax.data.reading import Number
from emgs_jax.data.timestamps import check_tolerance
from emgs_jax.data.tum import as_transform, nearest_lines, read_list

LAYOUT = "root/SEQUENCE/mav0/{cam0/{data.csv, sensor.yaml, data/}, state_groundtruth_estimate0/data.csv}"
SOURCE = "EuRoC MAV dataset of the ASL at ETH Zurich, the zip of a sequence in ASL format"
ORDER = (0, 1, 2, 4, 5, 6, 3)  # from x y z qw qx qy qz to TUM's order


@dataclass(eq=False)
class Euroc(PosedImages):
    """One camera of one sequence, such as "MH_01_easy", undistorted; without state_groundtruth_estimate0 no poses."""

    size: Sequence[int] = (376, 240)
    camera: str = "cam0"  # "cam0" (left) or "cam1"
    max_time_difference: Number = 0.02  # seconds between an image and its pose

    name, layout, source = "euroc", LAYOUT, SOURCE

    def __post_init__(self) -> None:
        folder = self._find(self.sequence)
        self._take(folder, read_euroc(folder / "mav0", self.camera, check_tolerance(self.max_time_difference)))


def read_euroc(folder: Path, camera: str, tolerance: float) -> Solved:
    """Read a camera's images and its true poses.

    Raises:
        FileNotFoundError: a file of the layout is missing.
        ValueError: it is damaged, the lens has another model, or no pose is near any image in time.
    """
    images, sensor = folder / camera / "data.csv", folder / camera / "sensor.yaml"
    for path in (images, sensor):
        if not path.is_file():
            raise FileNotFoundError(f"{path} is missing; expected the layout {LAYOUT} ({SOURCE})")
    times, names, _ = read_list(images, 2)
    found, T_body_camera = read_sensor(sensor)
    truth = folder / "state_groundtruth_estimate0" / "data.csv"
    known = nearest_lines(truth, 8, times, tolerance, "pose") if len(times) else None

    def pose(words: list[str], line: int) -> Pose | None:
        T_world_body = as_transform([words[i] for i in ORDER], f"{truth}, line {line}:")
        return None if T_world_body is None else T_world_body @ T_body_camera

    return Solved(
        [folder / camera / "data" / name for (name,) in names],
        [one and pose(*one) for one in known or [None] * len(times)],
        [found] * len(names),
        images,
        (images, sensor, *([truth] if truth.is_file() else [])),
        times.tolist(),
    )


def read_sensor(path: Path) -> tuple[Calibration, Pose]:
    """Read the camera of a sensor.yaml and T_body_camera, there T_BS."""
    values = parse_keys(reading.layout_text(path, LAYOUT), path)
    if "T_BS" not in values:
        raise ValueError(f"{path} has no T_BS, which a camera of EuRoC has: fetch it again")
    mounted = numbers_of(values["T_BS"], "T_BS", path)
    return kalibr_camera(values, path), reading.as_pose(" ".join(map(repr, mounted)), f"{path}: T_BS")

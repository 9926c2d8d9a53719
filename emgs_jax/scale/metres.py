"""`scale=`: the sources of a length in metres that a user gives, and what they say of a structure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from emgs_jax.data.base import Dataset
from emgs_jax.data.euroc import read_sensor
from emgs_jax.data.masks import files_of, names_of, stem
from emgs_jax.ops.ranges import number
from emgs_jax.scale.estimate import Scale, combined, scale_from
from emgs_jax.scale.floor import MIN_STD, Surfaces, certainties, floor_of, surfaces_of
from emgs_jax.scale.inertial import Inertial, frames_measured, read_inertial, scale_of_motion
from emgs_jax.scale.positions import (
    is_geographic,
    positions_of_exif,
    positions_of_poses,
    read_positions,
    scale_of_positions,
)
from emgs_jax.scale.tape import pixel_in, point_at, scale_of_distance, spread_of
from emgs_jax.scale.up import up_of_cameras, up_of_surfaces

NUM_VIEWS = 24  # frames in which a floor is looked for, evenly spread
NUM_BESIDE = 8  # frames that are asked for a point's depth, evenly spread
MAX_TILT_STD_DEG = 5.0  # of positions that tell up
MAX_LEAN_DEG = 45.0  # between up by the cameras and the z axis of positions, which may have any axes
MAX_ARM = 5.0  # metres between a camera and the unit beside it
PIXELS = 60  # of a frame's longer side, whose surfaces are used


@dataclass(frozen=True)
class ScaleConfig:
    """Where a length in metres comes from; several are combined by their uncertainty, none leaves the unit unknown."""

    # [image, x1, y1, x2, y2, metres], or several of these: two pixels of an image on disk and the metres between what
    # they show
    distance: Sequence[Any] | None = None
    height: float | None = number(None, low=1e-3, high=1e4)  # metres of the camera above the floor, in the median
    # Of the cameras: exif (GPS of photos), dataset (its poses, in metres, at which a structure is made), or a file, see
    # `read_positions`
    positions: str | None = None
    imu: str | None = None  # of an inertial measurement unit, see `read_inertial`
    # camera → unit: 16 numbers row by row, or a sensor.yaml of the camera as EuRoC has
    T_imu_camera: Sequence[float] | str | None = number(None, low=-1e3, high=1e3)

    def __post_init__(self) -> None:
        for one in self.distances:
            numbers = [value for value in one[1:] if isinstance(value, (int, float)) and np.isfinite(value)]
            if len(one) != 6 or len(numbers) != 5 or not one[5] > 0:
                raise ValueError(
                    f"scale.distance={[*one]} must be [image, x1, y1, x2, y2, metres]: the name of an image, two of "
                    "its pixels and the metres between what they show"
                )
        if self.imu is not None and self.T_imu_camera is None:
            raise ValueError(
                "scale.imu goes with scale.T_imu_camera: 16 numbers, camera → unit in metres, or the camera's "
                "sensor.yaml with T_BS"
            )

    @property
    def distances(self) -> list[Sequence[Any]]:
        """Each distance by itself."""
        if self.distance is None:
            return []
        is_several = all(isinstance(one, Sequence) and not isinstance(one, str) for one in self.distance)
        return [*self.distance] if is_several else [self.distance]

    @property
    def files(self) -> dict[str, Path]:
        """Files and folders by the key that names them."""
        imu = self.imu and self.imu.partition(":/")[0]
        named = {"imu": imu, "T_imu_camera": self.T_imu_camera, "positions": self.positions}
        known = {key: value for key, value in named.items() if isinstance(value, str)}
        return {key: Path(value).expanduser() for key, value in known.items() if value not in ("exif", "dataset")}

    @property
    def is_given(self) -> bool:
        """Whether there is any source."""
        return bool(self.distances) or any(value is not None for value in (self.height, self.positions, self.imu))


class View(NamedTuple):
    """What a frame shows."""

    points: Float[np.ndarray, "h w 3"]  # in the camera's axes, the structure's unit; 0 where there is none
    std: Float[np.ndarray, "h w"]  # of the logarithm of each depth


class Metres(NamedTuple):
    """What the sources say of a world."""

    scale: Scale | None  # None: nothing
    up: Float[np.ndarray, "3"] | None  # unit vector in the world; None unless a source tells it
    notes: tuple[str, ...]


class Given(NamedTuple):
    """The sources of a run, whose files are read; None for those that are not given."""

    config: ScaleConfig
    dataset: Dataset
    tapes: tuple[int, ...]  # frame of each distance
    positions: Float[np.ndarray, "n 3"] | None  # of all frames
    is_z_up: bool  # of the positions, for sure
    times: Float[np.ndarray, " n"] | None  # of all frames, seconds; None also where no source has times
    inertial: Inertial | None
    T_imu_camera: Float[np.ndarray, "4 4"] | None


def read_given(config: ScaleConfig, dataset: Dataset) -> Given:
    """Read the sources of a length; ValueError if one cannot be read, or is of other images than the data set's."""
    given, names = config.positions, names_of(dataset) if config.distances else ()
    tapes = tuple(_frame_of(str(image), names) for image, *_ in config.distances)
    for _, *pixels, _ in config.distances:
        _check_shown(pixels[:2], dataset)
        _check_shown(pixels[2:], dataset)
    is_file = given not in (None, "exif", "dataset")
    is_timed = is_file or config.imu is not None
    times = np.array([dataset[index].timestamp for index in range(len(dataset))]) if is_timed else None
    positions = _positions(given, dataset, times)
    is_z_up = given == "exif" or (is_file and is_geographic(Path(given).expanduser()))
    found = Given(config, dataset, tapes, positions, is_z_up, times, None, None)
    if config.imu is None:
        return found
    found = found._replace(inertial=read_inertial(config.imu), T_imu_camera=_mounted(config))
    frames_measured(times, found.inertial, f"scale.imu={config.imu}")
    return found


def metres_of(
    given: Given,
    poses: Float[np.ndarray, "n 4 4"],
    world: Int[np.ndarray, " n"],
    view: Callable[[int], View],
    scales: Sequence[Scale | None] = (),
) -> list[Metres]:
    """Find scale and up of each world of a structure, by all sources that are given.

    Args:
        poses: T_world_camera of each frame, in the unit of its world; NaN without one.
        world: number of each frame's world, from 0; -1 without one.
        view: what a frame with a pose shows.
        scales: what else is known of each world's scale, such as by a network.

    Raises:
        ValueError: the sources say nothing of the largest world, or no depth is known at a pixel.
    """
    found = []
    for one in range(max(world) + 1):
        own, up, notes = _of_world(given, poses, np.flatnonzero(world == one), view)
        own += filter(None, scales[one : one + 1])
        scale, warning = combined(own) if own else (None, None)
        found.append(Metres(scale, up, tuple(filter(None, [warning, *notes]))))
    if not found:
        raise ValueError("scale: no image has a pose")
    sizes = np.bincount(world[world >= 0])
    largest = found[int(sizes.argmax())]
    if largest.scale is None:
        of = f" of the largest model, of {sizes.max()} of {len(world)} images" if len(found) > 1 else ""
        raise ValueError(f"scale{of}: {'; '.join(largest.notes)}")
    return found


def _of_world(
    given: Given, all_poses: Float[np.ndarray, "n 4 4"], frames: Int[np.ndarray, " k"], view: Callable[[int], View]
) -> tuple[list[Scale], Float[np.ndarray, "3"] | None, list[str]]:
    """Scales of a world by each source that is given, its up by the last that tells it, and notes."""
    config, dataset, poses = given.config, given.dataset, all_poses[frames]
    up, scales, notes = None, [], []
    for (image, *pixels, metres), frame in zip(config.distances, given.tapes, strict=True):
        if frame not in frames:
            notes.append(f"image {image} of scale.distance has no pose in this model")
            continue
        places = [dataset.pixel_of(frame, np.array(pixels[k : k + 2])) for k in (0, 2)]
        ends = [point_at(*view(frame), place, np.array(dataset.intrinsics[:2])) for place in places]
        if None in ends:
            unknown = pixels[:2] if ends[0] is None else pixels[2:]
            raise ValueError(
                f"scale.distance: no depth is known at {unknown} of image {image}: choose points with texture, or "
                "another image"
            )
        points, stds = (np.stack(part) for part in zip(*ends, strict=True))
        world = [all_poses[frame][:3, :3] @ point + all_poses[frame][:3, 3] for point in points]
        stds = np.hypot(stds, [_spread(point, frames[frames != frame], all_poses, dataset, view) for point in world])
        scales.append(scale_of_distance(points, stds, dataset.intrinsics[0], float(metres), f"distance in {image}"))
    if config.height is not None:
        up, scale = _by_floor(config.height, frames, poses, view)
        scales += [] if scale is None else [scale]
        notes += ["no floor was found below the cameras"] if scale is None else []
    if given.positions is not None:
        try:
            placed = scale_of_positions(poses[:, :3, 3], given.positions[frames], "positions")
        except ValueError as error:
            notes.append(str(error))
        else:
            scales.append(placed.scale)
            notes.append(f"{placed.num_used} positions fit within {placed.residual:.2g} m")
            z = placed.T_metres_world.rotation.T @ np.array([0.0, 0.0, 1.0])
            is_up = given.is_z_up or z @ up_of_cameras(poses[:, :3, :3]) > np.cos(np.radians(MAX_LEAN_DEG))
            if placed.tilt_std_deg > MAX_TILT_STD_DEG:
                notes.append("they lie along a line, which leaves up open")
            elif not is_up:
                notes.append("their z axis is not up for the cameras, so they leave up open")
            else:
                up = z
    if given.inertial is not None:
        try:
            motion = scale_of_motion(given.times[frames], poses, given.inertial, given.T_imu_camera, "imu")
        except ValueError as error:
            notes.append(str(error))
        else:
            scales.append(motion.scale)
            up = motion.up
            notes.append(f"gravity by the imu (± {motion.up_std_deg:.1f}°)")
            if motion.late:
                side = "ahead of" if motion.late > 0 else "behind"
                notes.append(f"times of images are {1000 * abs(motion.late):.0f} ms {side} the imu's, which is mended")
    return scales, up, notes


def _frame_of(image: str, names: Sequence[str]) -> int:
    """The frame of an image's name, with or without suffix, or of its number in a video."""
    for name in (image, stem(image), image.zfill(6)):
        if name in names:
            return list(names).index(name)
    raise ValueError(
        f"scale.distance: image {image} is not in use: there are {names[0]} to {names[-1]} (dataset.start, stop and "
        "stride choose)"
    )


def _check_shown(pixel: Sequence[float], dataset: Dataset) -> None:
    (width, height), (x, y) = dataset.raw_size, pixel
    if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
        raise ValueError(f"scale.distance: there is no pixel {[*pixel]} on disk: images are {width}x{height}")


def _spread(
    point: Float[np.ndarray, "3"],
    frames: Int[np.ndarray, " k"],
    poses: Float[np.ndarray, "n 4 4"],
    dataset: Dataset,
    view: Callable[[int], View],
) -> float:
    """How far frames that show a point of the world are from its depth, see `spread_of`."""
    size, found = np.array(dataset.size), []
    for frame in frames:
        pixel, depth = pixel_in(point, poses[frame], dataset.intrinsics)
        if depth > 0 and ((pixel >= 0) & (pixel <= size - 1)).all():
            found.append((int(frame), pixel, depth))
    rows = np.unique(np.linspace(0, len(found) - 1, min(NUM_BESIDE, len(found))).round().astype(int))
    focal = np.array(dataset.intrinsics[:2])
    said = [(found[row][2], point_at(*view(found[row][0]), found[row][1], focal)) for row in rows]
    known = [(depth, float(seen[0][2])) for depth, seen in said if seen is not None]
    return spread_of([depth for depth, _ in known], [seen for _, seen in known])


def _by_floor(
    height: float,
    frames: np.ndarray,
    poses: Float[np.ndarray, "n 4 4"],
    view: Callable[[int], View],
) -> tuple[Float[np.ndarray, "3"] | None, Scale | None]:
    """Find up by floors and walls, and the scale by the median height of the cameras above the floor."""
    rows = np.unique(np.linspace(0, len(frames) - 1, min(NUM_VIEWS, len(frames))).round().astype(int))
    each = []
    for row in rows:
        points = view(int(frames[row])).points
        step = max(round(max(points.shape[:2]) / PIXELS), 1)
        each.append(surfaces_of(points, poses[row], step, int(row)))
    surfaces = Surfaces(*(np.concatenate(part) for part in zip(*each, strict=True)))
    up = up_of_surfaces(up_of_cameras(poses[:, :3, :3]), surfaces.normals, certainties(surfaces, poses[:, :3, 3]))
    floor = floor_of(surfaces, up, poses[rows, :3, 3], poses[:, :3, 3])
    if floor is None:
        return None, None
    middle = float(np.median(floor.heights))
    spread = 1.4826 * float(np.median(np.abs(floor.heights - middle))) / len(rows) ** 0.5
    std = np.hypot(spread, floor.std) / middle
    return floor.normal, scale_from("height", height, middle, np.hypot(std, MIN_STD))


def _positions(
    given: str | None, dataset: Dataset, times: Float[np.ndarray, " n"] | None
) -> Float[np.ndarray, "n 3"] | None:
    if given is None:
        return None
    if given == "exif":
        return positions_of_exif(files_of(dataset)[0])
    if given == "dataset":
        return positions_of_poses([dataset.pose(index) for index in range(len(dataset))], dataset.name)
    return read_positions(Path(given).expanduser(), names_of(dataset), times)


def _mounted(config: ScaleConfig) -> Float[np.ndarray, "4 4"]:
    """T_imu_camera as a matrix."""
    given = config.T_imu_camera
    if isinstance(given, str) and not Path(given).expanduser().is_file():
        raise ValueError(f"scale.T_imu_camera={given} is no file: give 16 numbers, or the camera's sensor.yaml")
    T = read_sensor(Path(given).expanduser())[1] if isinstance(given, str) else np.asarray(given, np.float64)
    if T.size != 16 or not np.allclose(T.reshape(4, 4)[:3, :3] @ T.reshape(4, 4)[:3, :3].T, np.eye(3), atol=1e-3):
        raise ValueError(f"scale.T_imu_camera must be the 16 numbers of a rigid motion, row by row, got {given}")
    arm = float(np.linalg.norm(T.reshape(4, 4)[:3, 3]))
    if arm > MAX_ARM:
        raise ValueError(f"scale.T_imu_camera: the camera is {arm:.3g} m from the unit: its translation is in metres")
    return T.reshape(4, 4)

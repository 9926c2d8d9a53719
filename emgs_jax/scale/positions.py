"""Positions of cameras in metres: GPS in the EXIF of photos, or a file of positions."""

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from PIL import ExifTags, Image

from emgs_jax.data.camera_models import load_pycolmap
from emgs_jax.data.file_names import last_number
from emgs_jax.data.timestamps import in_seconds, nearest_rows
from emgs_jax.geometry import Sim3, similarity_of
from emgs_jax.scale.estimate import Scale
from emgs_jax.scale.lines import numbers_in, words_of

GEOGRAPHIC = "EPSG:4326"  # first line of a file with longitude, latitude, altitude; as ODM's geo.txt
MAX_TIME_DIFFERENCE = 0.05  # seconds between a frame and a line with a time
MIN_POSITIONS = 4
MIN_SPREAD = 3.0  # residuals that positions lie apart, or they tell no scale
MAX_OFF = 3.0  # standard deviations within which a position counts
NUM_STEPS = 10


class Placed(NamedTuple):
    """A path brought to positions in metres."""

    scale: Scale
    T_metres_world: Sim3
    residual: float  # metres, root mean square of the positions that count
    num_used: int
    tilt_std_deg: float  # of the z axis of the positions, in the world; large where they lie on a level line


def positions_of_exif(files: Sequence[Path | None]) -> Float[np.ndarray, "n 3"]:
    """Read GPS positions of photos, in metres east, north and up of the first one; NaN where there is none.

    Raises:
        ValueError: fewer than `MIN_POSITIONS` files have a position.
    """
    found = np.full((len(files), 3), np.nan)
    for row, path in enumerate(files):
        if path is not None:
            found[row] = _of_exif(path)
    count = int(np.isfinite(found).all(axis=1).sum())
    if count < MIN_POSITIONS:
        raise ValueError(
            f"scale.positions=exif: {count} of {len(files)} images have a GPS position with altitude in their EXIF, "
            f"and {MIN_POSITIONS} are needed: videos and edited photos have none; give a file of positions"
        )
    return _in_metres(found)


def positions_of_poses(poses: Sequence[Float[np.ndarray, "4 4"] | None], name: str) -> Float[np.ndarray, "n 3"]:
    """Return the positions of poses in metres, NaN where there is none; ValueError for fewer than `MIN_POSITIONS`."""
    found = np.array([np.full(3, np.nan) if pose is None else pose[:3, 3] for pose in poses], np.float64)
    count = int(np.isfinite(found).all(axis=1).sum())
    if count < MIN_POSITIONS:
        raise ValueError(
            f"scale.positions=dataset: {count} of {len(found)} frames of {name} have a pose, and {MIN_POSITIONS} are "
            "needed: give the data set its poses, or a file of positions (scale.positions=FILE)"
        )
    return found.reshape(-1, 3)


def _of_exif(path: Path) -> tuple[float, float, float]:
    """Latitude, longitude (degrees) and altitude (m) of a photo; NaN without them."""
    nothing = (np.nan, np.nan, np.nan)
    try:
        with Image.open(path) as image:
            tags = image.getexif().get_ifd(ExifTags.IFD.GPSInfo)
    except (OSError, ValueError, SyntaxError):
        return nothing
    names = ExifTags.GPS
    try:
        angles = [
            float(np.dot([float(part) for part in tags[tag]], (1, 1 / 60, 1 / 3600)))
            for tag in (names.GPSLatitude, names.GPSLongitude)
        ]
        altitude = float(tags[names.GPSAltitude])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return nothing
    south, west = tags.get(names.GPSLatitudeRef) == "S", tags.get(names.GPSLongitudeRef) == "W"
    below = tags.get(names.GPSAltitudeRef) in (b"\x01", 1)
    return angles[0] * (-1) ** south, angles[1] * (-1) ** west, altitude * (-1) ** below


def _pycolmap() -> ModuleType:
    return load_pycolmap("scale.positions needs pycolmap: install it from source (for Linux on ARM there is no wheel)")


def _in_metres(geographic: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Turn latitude, longitude, altitude into metres east, north and up of the first known one."""
    is_known = np.isfinite(geographic).all(axis=1)
    found = np.full(geographic.shape, np.nan)
    found[is_known] = _pycolmap().GPSTransform().ellipsoid_to_enu(geographic[is_known], *geographic[is_known][0])
    return found


def is_geographic(path: Path) -> bool:
    """Whether a file of positions has longitude, latitude and altitude: then z is up, and in others it may not be."""
    return next((words[0].upper() == GEOGRAPHIC for _, _, words in words_of(path)), False)


def read_positions(path: Path, names: Sequence[str], times: Sequence[float]) -> Float[np.ndarray, "n 3"]:
    """Read a position for each frame, metres; NaN where there is none.

    A line has the name of an image, its number or a time in seconds, and x y z in metres; further words are not read,
    so a trajectory of TUM will do. After a first line `EPSG:4326` they are longitude, latitude and altitude, as in
    ODM's geo.txt.

    Args:
        names: of the frames, without suffix.
        times: of the frames, seconds.

    Raises:
        ValueError: a line cannot be read, whole numbers may be those of frames and seconds, or fewer than
            `MIN_POSITIONS` frames have a position.
    """
    if not path.is_file():
        raise ValueError(f"scale.positions={path} is no file: give one, exif or dataset")
    is_geographic, keys, values = False, [], []
    for number, line, words in words_of(path):
        if len(words) == 1 and not keys:
            is_geographic = words[0].upper() == GEOGRAPHIC
            if not is_geographic:
                raise ValueError(
                    f"{path}, line {number}: {words[0]} is no reference that is known: {GEOGRAPHIC} is, and metres are "
                    "taken without one"
                )
            continue
        place = numbers_in(words[1:4])
        if place is None and not keys:  # a heading
            continue
        if place is None or len(place) < 3:
            raise ValueError(f"{path}, line {number}: expected a name or a time and x y z, got {line!r}")
        keys.append(words[0])
        values.append(place)
    table, found = np.array(values, np.float64).reshape(-1, 3), np.full((len(names), 3), np.nan)
    rows = _rows_of(path, keys, names, times)
    for frame, row in enumerate(rows):
        if row >= 0:
            found[frame] = table[row, [1, 0, 2]] if is_geographic else table[row]
    count = sum(row >= 0 for row in rows)
    if count < MIN_POSITIONS:
        raise ValueError(
            f"{path}: {count} of {len(names)} images have a position, and {MIN_POSITIONS} are needed: its lines begin "
            f"with {', '.join(keys[:3])}, the images are called {', '.join(names[:3])}"
        )
    return _in_metres(found) if is_geographic else found


def _rows_of(path: Path, keys: Sequence[str], names: Sequence[str], times: Sequence[float]) -> list[int]:
    """Row of each frame by its name, by the last number of its name, or by its time; -1 without one.

    Raises:
        ValueError: whole numbers fit frames as their numbers, not one to one, and otherwise as seconds.
    """
    stems = {Path(key).stem: row for row, key in enumerate(keys)}
    by_name = [stems.get(name, -1) for name in names]
    clock = numbers_in(keys)
    if clock is None:
        return by_name
    numbers = [last_number(name) for name in names]
    is_counted = all(key.isdecimal() for key in keys) and len({*numbers}) == len(numbers)
    counted = {int(key): row for row, key in enumerate(keys)} if is_counted else {}
    by_number = [counted.get(number, -1) for number in numbers]
    if max(by_name, default=-1) >= 0:
        return by_number if is_counted else by_name
    order = np.argsort(clock, kind="stable")
    near = nearest_rows(np.asarray(times, np.float64), in_seconds(np.array(clock)[order]), MAX_TIME_DIFFERENCE)
    by_time = [int(order[row]) if row >= 0 else -1 for row in near]
    if counted.keys() == {*numbers} or by_number == by_time:
        return by_number
    num_counted, num_timed = (len({*rows} - {-1}) for rows in (by_number, by_time))
    if min(num_counted, num_timed) >= MIN_POSITIONS:
        raise ValueError(
            f"{path}: its lines begin with {', '.join(keys[:3])}, which may be numbers of frames or seconds: write "
            f"names, such as {names[0]}, for the former, and seconds with a point, such as {float(clock[0])}"
        )
    return by_number if num_counted > num_timed else by_time


def scale_of_positions(centers: Float[np.ndarray, "n 3"], positions: Float[np.ndarray, "n 3"], source: str) -> Placed:
    """Bring a path to positions by a similarity (Umeyama 1991), of those within `MAX_OFF` standard deviations of it.

    With residuals of variance r² in each coordinate, σ² of the log of the scale is r² / Σ |y_k - ȳ|², where y are the
    positions.

    Args:
        centers: of the cameras, in any unit; NaN where there is none.
        positions: of the cameras, metres; likewise.

    Raises:
        ValueError: too few positions, or they lie no farther apart than they err.
    """
    is_known = np.isfinite(centers).all(axis=1) & np.isfinite(positions).all(axis=1)
    if is_known.sum() < MIN_POSITIONS:
        raise ValueError(
            f"{source}: {is_known.sum()} frames have a pose and a position, and {MIN_POSITIONS} are needed"
        )
    used = is_known
    if not np.ptp(centers[used], axis=0).any():
        raise ValueError(f"{source}: the path does not move, so positions tell no scale")
    for _ in range(NUM_STEPS):
        similarity = similarity_of(centers[used], positions[used])
        off = np.linalg.norm(similarity.apply(centers) - positions, axis=1)
        std = 1.4826 * float(np.median(off[is_known]))
        near = is_known & (off <= max(MAX_OFF * std, 1e-9))
        if near.sum() < MIN_POSITIONS or (near == used).all():
            break
        used = near
    apart = positions[used] - positions[used].mean(axis=0)
    spread = float(np.sqrt(np.sum(apart**2)))
    if not spread > 0:
        raise ValueError(f"{source}: the positions do not move, so they tell no scale")
    residual = float(np.sqrt(np.mean(off[used] ** 2)))
    degrees = max(3 * int(used.sum()) - 7, 1)
    std = float(np.sqrt(np.sum(off[used] ** 2) / degrees)) / spread
    apart_by = spread / float(used.sum()) ** 0.5
    if residual * MIN_SPREAD > apart_by:
        raise ValueError(
            f"{source}: positions are off by {residual:.2g} m and lie {apart_by:.2g} m from their middle, so they "
            "tell no scale: are they of these images, and in metres?"
        )
    scale = Scale(source, float(np.log(similarity.scale)), max(std, 1e-6))
    tilt_std = _tilt_std(similarity.apply(centers[used]), std * spread)
    return Placed(scale, similarity, residual, int(used.sum()), tilt_std)


def _tilt_std(path: Float[np.ndarray, "n 3"], std: float) -> float:
    """Standard deviation in degrees of the z axis of positions by which a path y is turned, each with `std`.

    A turn w moves it by w × y, so its information is Σ (|y|² I - y yᵀ) / std², from the middle; it moves the z axis by
    w × z. Positions themselves lie beside a line by their errors.
    """
    apart = path - path.mean(axis=0)
    known = np.sum(apart**2) * np.eye(3) - apart.T @ apart
    covariance = std**2 * np.linalg.inv(known + 1e-12 * np.trace(known) * np.eye(3))
    return float(np.degrees(np.sqrt(covariance[0, 0] + covariance[1, 1])))

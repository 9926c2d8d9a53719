"""Positions of cameras: EXIF, files, and the alignment of a path."""

import numpy as np
import pytest
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation

from emgs_jax.scale.positions import positions_of_exif, positions_of_poses, read_positions, scale_of_positions

NAMES = [f"DJI_{index:04}" for index in range(5)]


def photo(path, place=None, refs=("N", "W", b"\x00")):
    image, tags = Image.new("RGB", (8, 8)), Image.Exif()
    if place is not None:
        gps = ExifTags.GPS
        tags[ExifTags.IFD.GPSInfo] = {
            gps.GPSLatitudeRef: refs[0],
            gps.GPSLatitude: place[0],
            gps.GPSLongitudeRef: refs[1],
            gps.GPSLongitude: place[1],
            gps.GPSAltitudeRef: refs[2],
            gps.GPSAltitude: place[2],
        }
    image.save(path, exif=tags)
    return path


def test_exif_positions_are_metres_east_north_and_up(tmp_path):
    second = 30.87  # metres of a second of latitude
    places = [((46, 50, 33.0 + row), (91, 59, 40.0 - row), 198.0 + row) for row in range(4)]
    files = [photo(tmp_path / f"{row}.jpg", place) for row, place in enumerate(places)]
    files += [photo(tmp_path / "none.jpg"), None]
    found = positions_of_exif(files)
    assert np.isnan(found[4:]).all() and found[0] == pytest.approx([0, 0, 0], abs=1e-6)
    assert found[2, 1] == pytest.approx(2 * second, rel=0.01)
    assert found[2, 0] == pytest.approx(2 * second * np.cos(np.radians(46.84)), rel=0.01)  # less west is east
    assert found[2, 2] == pytest.approx(2.0, abs=1e-3)


def test_south_and_below_the_sea_are_negative(tmp_path):
    places = [((10, 0, float(row)), (20, 0, 0.0), 5.0 + row) for row in range(4)]
    files = [photo(tmp_path / f"{row}.jpg", place, ("S", "E", b"\x01")) for row, place in enumerate(places)]
    found = positions_of_exif(files)
    assert found[3, 1] == pytest.approx(-3 * 30.72, rel=0.01) and found[3, 2] == pytest.approx(-3.0, abs=1e-3)


def test_photos_without_gps_are_an_error(tmp_path):
    with pytest.raises(ValueError, match="0 of 2 images have a GPS position"):
        positions_of_exif([photo(tmp_path / "a.jpg"), photo(tmp_path / "b.jpg")])


def test_poses_of_a_data_set_are_positions():
    pose = np.eye(4)
    pose[:3, 3] = [1.0, 2.0, 3.0]
    found = positions_of_poses([pose, None, pose, pose, pose], "tum")
    assert (found[[0, 2]] == [1, 2, 3]).all() and np.isnan(found[1]).all()
    with pytest.raises(ValueError, match="scale.positions=dataset: 1 of 2 frames of photos have a pose, and 4"):
        positions_of_poses([None, pose], "photos")


def test_positions_by_name(tmp_path):
    path = tmp_path / "places.txt"
    path.write_text(
        "image x y z\n# a comment\n" + "".join(f"{name}.JPG, {row}, {2 * row}, 3\n" for row, name in enumerate(NAMES))
    )
    found = read_positions(path, [*NAMES, "DJI_0099"], [0.0] * 6)
    assert found[:5] == pytest.approx(np.array([[row, 2 * row, 3] for row in range(5)]))
    assert np.isnan(found[5]).all()


@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_a_trajectory_of_tum_is_read_by_its_times(tmp_path, mark):
    """With a byte order mark, as Windows writes it, too: it hid the number of the first line."""
    path = tmp_path / "path.txt"
    path.write_text(mark + "".join(f"{1305031100 + 0.1 * row:.3f} {row} 0 1 0 0 0 1\n" for row in range(5)), "utf-8")
    found = read_positions(path, NAMES, [1305031100.01 + 0.1 * row for row in range(4)] + [1305031150.0])
    assert found[:4, 0] == pytest.approx([0, 1, 2, 3]) and np.isnan(found[4]).all()


VIDEO = [f"{index:06}" for index in range(300)], [index / 30 for index in range(300)]


def numbered(path, numbers, form="{}"):
    path.write_text("".join(f"{form.format(number)} {number} 0 1\n" for number in numbers))
    return path


def test_numbers_of_frames_are_no_seconds(tmp_path):
    """Symptom: lines 0, 1, 2, … of a video were seconds, and a straight walk had a thirtieth of its scale."""
    path = numbered(tmp_path / "path.txt", range(300))
    assert (read_positions(path, *VIDEO)[:, 0] == np.arange(300)).all()
    assert (read_positions(path, [f"frame-{name}.color" for name in VIDEO[0]], VIDEO[1])[:, 0] == np.arange(300)).all()
    later = [1.7e9 + time for time in VIDEO[1]]
    assert (read_positions(numbered(path, range(0, 300, 3)), VIDEO[0], later)[::3, 0] == np.arange(0, 300, 3)).all()
    mixed = [f"{index:03}" for index in range(990, 1010)]  # some are names as well
    found = read_positions(numbered(path, range(990, 1010)), mixed, [index / 30 for index in range(20)])
    assert (found[:, 0] == np.arange(990, 1010)).all()


def test_whole_numbers_that_fit_as_frames_and_as_seconds_are_refused(tmp_path):
    """Ten seconds of GPS once a second, or positions of the first eleven frames."""
    path = tmp_path / "path.txt"
    with pytest.raises(ValueError, match=r"begin with 0, 1, 2, .* such as 000000, .* such as 0.0"):
        read_positions(numbered(path, range(11)), *VIDEO)
    assert (read_positions(numbered(path, range(11), "{:06}"), *VIDEO)[:11, 0] == np.arange(11)).all()
    assert (read_positions(numbered(path, range(11), "{}.0"), *VIDEO)[[0, 30, 270], 0] == [0, 1, 9]).all()


def test_geographic_positions_are_longitude_first(tmp_path):
    path = tmp_path / "geo.txt"
    path.write_text(
        "EPSG:4326\n" + "".join(f"{name} {10 + row / 3600} 50 {7 * row}\n" for row, name in enumerate(NAMES))
    )
    found = read_positions(path, NAMES, [0.0] * 5)
    assert found[2] == pytest.approx([2 * 19.9, 0.0, 14.0], abs=0.1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EPSG:32615\nDJI_0000 1 2 3\n", "EPSG:32615 is no reference"),
        ("DJI_0000 1 2 3\nDJI_0001 1 2\n", "line 2: expected a name or a time"),
        ("a 1 2 3\nb 1 2 3\n", "0 of 5 images have a position"),
    ],
)
def test_files_that_cannot_be_read_are_named(tmp_path, text, message):
    path = tmp_path / "places.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_positions(path, NAMES, [0.0] * 5)
    with pytest.raises(ValueError, match="is no file"):
        read_positions(tmp_path / "none.txt", NAMES, [0.0] * 5)


def path_and_positions(rng, noise, count=30, scale=0.4):
    positions = np.cumsum(rng.normal(size=(count, 3)), axis=0)
    turn = Rotation.random(random_state=3).as_matrix()
    centers = scale * positions @ turn.T + [1.0, 2.0, 3.0]
    return centers, positions + noise * rng.normal(size=positions.shape), turn


def test_a_path_is_aligned_without_the_positions_that_are_wrong():
    rng = np.random.default_rng(0)
    centers, positions, turn = path_and_positions(rng, 0.01)
    positions[[3, 17]] += [40.0, 0.0, 0.0]
    centers[5], positions[6] = np.nan, np.nan
    placed = scale_of_positions(centers, positions, "positions")
    assert placed.num_used == 26 and placed.residual == pytest.approx(0.017, rel=0.3)
    assert placed.scale.factor == pytest.approx(2.5, rel=0.005)
    assert placed.T_metres_world.rotation == pytest.approx(turn.T, abs=0.01)


@pytest.mark.parametrize("level", [[1, 1, 0], [1, 0, 0]])
def test_positions_in_a_plane_or_on_a_line_tell_the_scale(level):
    """Symptom: pycolmap finds no similarity to positions of rank 2, as of a robot on wheels: they "do not move"."""
    rng = np.random.default_rng(0)
    positions = np.cumsum(rng.normal(size=(30, 3)), axis=0) * level
    centers = 0.4 * positions @ Rotation.random(random_state=3).as_matrix() + 0.001 * rng.normal(size=(30, 3))
    placed = scale_of_positions(centers, positions, "positions")
    assert placed.scale.factor == pytest.approx(2.5, rel=0.002)
    assert (placed.tilt_std_deg > 5) == (sum(level) == 1)


def test_the_scale_of_positions_is_calibrated():
    off = []
    for seed in range(200):
        centers, positions, _ = path_and_positions(np.random.default_rng(seed), 0.3)
        scale = scale_of_positions(centers, positions, "positions").scale
        off.append((scale.log - np.log(2.5)) / scale.std)
    assert 0.8 < np.std(off) < 1.25


def test_the_tilt_of_positions_is_calibrated_and_large_along_a_level_line():
    off, said = [], []
    for seed in range(200):
        centers, positions, turn = path_and_positions(np.random.default_rng(seed), 0.3)
        placed = scale_of_positions(centers, positions, "positions")
        z = placed.T_metres_world.rotation @ turn[:, 2]
        off.append(np.degrees(np.arccos(z[2])))
        said.append(placed.tilt_std_deg)
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(np.sqrt(np.mean(np.square(said))), rel=0.2)
    rng = np.random.default_rng(0)
    bent, noise = 0.001 * rng.normal(size=(20, 3)), 0.01 * rng.normal(size=(20, 3))
    for line, low, high in (([1.0, 0.5, 0.0], 20, 1e9), ([0.0, 0.0, 1.0], 0, 0.1)):  # a turn about z leaves it
        path = np.outer(np.arange(20.0), line) + bent
        assert low < scale_of_positions(path, path + noise, "positions").tilt_std_deg < high


def test_positions_of_something_else_tell_no_scale():
    rng = np.random.default_rng(0)
    centers, positions, _ = path_and_positions(rng, 0.0)
    with pytest.raises(ValueError, match="tell no scale"):
        scale_of_positions(centers[:8], rng.permutation(positions)[:8], "positions")


def test_positions_that_do_not_move_tell_no_scale():
    centers, positions, _ = path_and_positions(np.random.default_rng(0), 0.0)
    with pytest.raises(ValueError, match="no scale|do not move"):
        scale_of_positions(centers, np.zeros_like(positions), "positions")
    with pytest.raises(ValueError, match="3 frames have a pose"):
        scale_of_positions(centers[:3], positions[:3], "positions")

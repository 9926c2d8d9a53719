"""Scale and gravity from a simulated inertial measurement unit, whose biases and errors are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from emgs_jax.scale.inertial import GRAVITY, Inertial, read_inertial, scale_of_motion

RATE, SECONDS, FPS = 200, 16.0, 10
T_IMU_CAMERA = np.eye(4)
T_IMU_CAMERA[:3, :3] = Rotation.from_euler("xyz", [88, 3, -91], degrees=True).as_matrix()
T_IMU_CAMERA[:3, 3] = [0.05, -0.03, 0.1]
BIASES = np.array([0.002, -0.02, 0.07]), np.array([-0.02, 0.3, 0.07])


def walk(seed=0, noise=0.0, unit=0.37, errors=True):
    """A hand-held walk: times, camera poses in another unit and world, and what the unit measures."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, SECONDS, 1 / RATE)
    waves, phases = rng.uniform(0.2, 0.9, (6, 3)), rng.uniform(0, 6.28, (6, 3))
    size = np.array([0.5, 0.5, 0.15])
    arg = 2 * np.pi * waves[:3] * t[:, None, None] + phases[:3]
    position = (size * np.sin(arg)).sum(axis=1)
    acceleration = (-size * (2 * np.pi * waves[:3]) ** 2 * np.sin(arg)).sum(axis=1)
    angles = (0.25 * np.sin(2 * np.pi * waves[3:] * t[:, None, None] + phases[3:])).sum(axis=1)
    rotation = Rotation.from_euler("xyz", angles)
    rates = np.zeros((len(t), 3))
    rates[1:-1] = (rotation[:-2].inv() * rotation[2:]).as_rotvec() * RATE / 2
    force = rotation.inv().apply(acceleration + [0, 0, GRAVITY])
    if errors:
        rates = rates + BIASES[0] + 2e-3 * rng.normal(size=rates.shape)
        force = force + BIASES[1] + 3e-2 * rng.normal(size=force.shape)
    rows = np.arange(RATE // FPS, len(t) - RATE // FPS, RATE // FPS)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = (rotation[rows] * Rotation.from_matrix(T_IMU_CAMERA[:3, :3])).as_matrix()
    poses[:, :3, 3] = (
        position[rows] + rotation[rows].apply(T_IMU_CAMERA[:3, 3]) + noise * rng.normal(size=(len(rows), 3))
    )
    turn = Rotation.random(random_state=seed).as_matrix()
    world = np.eye(4)
    world[:3, :3] = turn
    poses = world @ poses
    poses[:, :3, 3] = unit * poses[:, :3, 3] + [4.0, 5.0, 6.0]
    return t[rows], poses, Inertial(t, rates, force), turn[:, 2]


def angle(a, b) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


def test_scale_gravity_and_biases_are_found():
    times, poses, measured, up = walk()
    motion = scale_of_motion(times, poses, measured, T_IMU_CAMERA, "imu")
    assert motion.scale.factor == pytest.approx(1 / 0.37, rel=0.01)
    assert angle(motion.up, up) < 0.5
    assert motion.gyroscope_bias == pytest.approx(BIASES[0], abs=2e-3)
    assert motion.accelerometer_bias == pytest.approx(BIASES[1], abs=0.08)


def test_a_noisier_path_is_less_sure_of_scale_and_up():
    clean, noisy = (scale_of_motion(*walk(noise=noise)[:3], T_IMU_CAMERA, "imu") for noise in (0.0, 0.03))
    assert 1e-4 < clean.scale.std < 1e-3 and 1e-3 < noisy.scale.std < 0.01
    assert 0.1 < clean.up_std_deg < 0.4 < noisy.up_std_deg < 1.0


def test_the_arm_from_the_camera_counts():
    times, poses, measured, *_ = walk(errors=False)
    without = T_IMU_CAMERA.copy()
    without[:3, 3] += 0.5
    right = scale_of_motion(times, poses, measured, T_IMU_CAMERA, "imu").scale
    wrong = scale_of_motion(times, poses, measured, without, "imu").scale
    assert abs(right.log + np.log(0.37)) < 0.005 < abs(wrong.log + np.log(0.37))


@pytest.mark.parametrize("wrong", ["inverse", "no turn", "deg/s", "clock"])
def test_rates_that_turn_otherwise_than_the_frames_are_an_error(wrong):
    """Symptom: with the inverse of T_imu_camera, as Kalibr writes it, the scale was 5.6 times too large, ± 18 %."""
    times, poses, measured, *_ = walk(1)
    mounted = {"inverse": np.linalg.inv(T_IMU_CAMERA), "no turn": np.eye(4)}.get(wrong, T_IMU_CAMERA)
    rates = np.degrees(measured.rates) if wrong == "deg/s" else measured.rates
    late = 0.5 if wrong == "clock" else 0.0
    with pytest.raises(ValueError, match=r"the frames turn by 3\d° and the rates otherwise.*check that T_imu_camera"):
        scale_of_motion(times + late, poses, measured._replace(rates=rates), mounted, "imu")


@pytest.mark.parametrize("late", [0.05, -0.15])
def test_clocks_that_are_not_one_are_mended(late):
    """Symptom: 50 ms made the scale 3.5 % wrong, ± 1.1 %, and 80 ms 12.7 %, ± 2.7 %."""
    times, poses, measured, up = walk(4, noise=0.01)
    motion = scale_of_motion(times + late, poses, measured, T_IMU_CAMERA, "imu")
    assert motion.late == pytest.approx(late, abs=2e-3)
    assert abs(motion.scale.log + np.log(0.37)) < 3 * motion.scale.std < 0.01 and angle(motion.up, up) < 1


def test_one_clock_stays_as_it_is():
    times, poses, measured, _ = walk(4, noise=0.01)
    turns = Rotation.from_rotvec(np.radians(0.1) * np.random.default_rng(0).normal(size=(len(poses), 3)))
    poses[:, :3, :3] = poses[:, :3, :3] @ turns.as_matrix()
    assert scale_of_motion(times, poses, measured, T_IMU_CAMERA, "imu").late == 0.0


@pytest.mark.slow
def test_the_scale_of_motions_is_calibrated():
    off, tilt = [], []
    for seed in range(12):
        times, poses, measured, up = walk(seed, noise=0.01)
        motion = scale_of_motion(times, poses, measured, T_IMU_CAMERA, "imu")
        off.append((motion.scale.log + np.log(0.37)) / motion.scale.std)
        tilt.append(angle(motion.up, up))
    assert np.sqrt(np.mean(np.square(off))) < 1.5 and max(np.abs(off)) < 3
    assert np.median(tilt) < 1


def test_frames_without_measurements_are_an_error():
    times, poses, measured, *_ = walk()
    with pytest.raises(ValueError, match="by the clock of the images"):
        scale_of_motion(times + 1e6, poses, measured, T_IMU_CAMERA, "imu")
    with pytest.raises(ValueError, match="too few"):
        scale_of_motion(times[:15], poses[:15], measured, T_IMU_CAMERA, "imu")


def test_a_table_of_euroc_is_read(tmp_path):
    path = tmp_path / "data.csv"
    rows = [f"{1403715273262142976 + 5000000 * row},0.1,0.2,0.3,9.1,0.1,-3.7" for row in range(12)]
    path.write_text("#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z\n" + "\n".join(rows))
    measured = read_inertial(str(path))
    assert np.diff(measured.times) == pytest.approx(0.005, abs=1e-6)
    assert measured.rates[3] == pytest.approx([0.1, 0.2, 0.3]) and measured.accelerations[3, 2] == -3.7


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("{t} 0 0 0 0 0 1", "1 g = 9.81"),
        ("{t} 0 0 0 0 0", "expected a time, three rates"),
        ("1 0 0 0 0 0 9.8", "ascending times"),
    ],
)
def test_tables_of_something_else_are_named(tmp_path, row, message):
    path = tmp_path / "imu.txt"
    path.write_text("time wx wy wz ax ay az\n" + "\n".join(row.format(t=0.01 * index) for index in range(20)))
    with pytest.raises(ValueError, match=message):
        read_inertial(str(path))
    with pytest.raises(ValueError, match="scale.imu=.* is no file"):
        read_inertial(str(tmp_path / "none.csv"))


@pytest.mark.parametrize("version", [1, 2])
def test_a_topic_of_a_bag_is_read_as_a_table_is(tmp_path, version):
    """Its times are those of the headers, not of the recording, which is late."""
    pytest.importorskip("rosbags", reason="reads bags: pip install -e .[rosbag]")
    from tests.data.written_bag import write_imu

    rng = np.random.default_rng(0)
    stamps = 1_700_000_000_000_000_000 + 5_000_000 * np.arange(40)
    rows = rng.normal(size=(40, 6)) + [0, 0, 0, 0, 0, GRAVITY]
    table = [(int(stamp), *row) for stamp, row in zip(stamps, rows, strict=True)]
    shuffled = [*table[:7], table[8], table[7], *table[9:], table[-1]]  # late, and twice
    bag = str(write_imu(tmp_path, version, shuffled, delay=30_000_000))
    (tmp_path / "data.csv").write_text(
        "\n".join(f"{stamp}, {', '.join(map(repr, map(float, row)))}" for stamp, *row in table)
    )
    expected = read_inertial(str(tmp_path / "data.csv"))
    for given in (bag, f"{bag}:/imu"):
        found = read_inertial(given)
        np.testing.assert_allclose(found.times, expected.times, rtol=0, atol=1e-6)
        np.testing.assert_array_equal(found.rates, expected.rates)
        np.testing.assert_array_equal(found.accelerations, rows[:, 3:])


def test_a_bag_of_several_units_asks_which_and_one_without_rates_is_refused(tmp_path):
    pytest.importorskip("rosbags", reason="reads bags: pip install -e .[rosbag]")
    from tests.data.written_bag import write_imu

    table = [(10**9 + row, 0.1, 0, 0, 0, 0, 9.8) for row in range(20)]
    bag = write_imu(tmp_path, 2, table, ("/left/imu", "/right/imu"))
    with pytest.raises(ValueError, match=r"several of .*Imu: give scale.imu=\S*imu:TOPIC, one of /left/imu, /"):
        read_inertial(str(bag))
    with pytest.raises(ValueError, match="no topic /imu"):
        read_inertial(f"{bag}:/imu")
    assert len(read_inertial(f"{bag}:/right/imu").times) == 20
    (tmp_path / "one").mkdir()
    still = write_imu(tmp_path / "one", 2, [(time, 0, 0, 0, *rest) for time, _, _, _, *rest in table])
    with pytest.raises(ValueError, match="all rates are 0"):
        read_inertial(str(still))

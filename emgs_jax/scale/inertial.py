"""Scale and gravity from the motions of an inertial measurement unit beside the camera (Martinelli, IJCV 2014).

In a window of some seconds the gyroscope turns the unit, and the frames' rotations place it in the world, in the mean.
Then the double integral of what the accelerometer measures is linear in nearly all that is unknown. With q units of
length in a metre, a camera at p at the time τ of a window is at

    p = q (P(τ) - d) - A(τ) b - B(τ) w + ½ τ² γ + c + τ v,

where P = ∬ R a is the integral of the measured accelerations, A = ∬ R that of the rotations, B the change of P by the
gyroscope's bias, and d the arm from the camera to the unit, in the world's axes. b and w are the biases, γ is gravity,
c and v are position and velocity at the start of the window, all times q. The errors of the positions are on the left,
so q is not biased. q, b and w are shared; each window has its own c, v and γ with |γ| = 9.81 q, so that a tilt of its
rotations, which mixes gravity into P, does not count. Errors are those of the path, and the double integral of errors
of the acceleration that stay for some seconds; the former are chosen such that residuals are as large as expected.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation, Slerp

from emgs_jax.data.rosbag import is_bag, read_imu
from emgs_jax.data.timestamps import in_seconds
from emgs_jax.scale.estimate import Scale
from emgs_jax.scale.lines import numbers_in, words_of

GRAVITY = 9.81  # m/s²
GRAVITY_STD = 0.02  # m/s², over the Earth
WINDOW = 10.0  # seconds of a window
MIN_FRAMES = 8  # of a window
MAX_GAP = 2.0  # seconds between frames that the gyroscope bridges
MIN_SECONDS = 3.0  # of a path
MAX_LATE, LATE_STEP = 0.2, 0.01  # seconds between two clocks that are mended
# Root mean square by which rates may turn a window's frames otherwise than their rotations: degrees, or a share of how
# far these turn. Of right ones it is .01, of a clock that is a twentieth of a second off .25, of other axes 1.5.
MAX_TURNED_OFF = 5.0, 0.5
MAX_STD = 1.0  # of the log of a scale
BIASES_STD = 0.5, 0.003  # m/s² and rad/s: of the accelerometer, and what frames' rotations leave of the gyroscope's
BIAS_STEP = 1e-4  # rad/s, for the change of P
# Errors of the acceleration, m/s² and the seconds for which they stay: a tilt of .4° mixes .07 m/s² of gravity into it.
ERROR_STD, ERROR_TIME = 0.07, 2.0
ERROR_STEP = 0.05  # seconds
NOISES = np.geomspace(3e-4, 0.3, 16)  # metres, of the path's positions
SHARED = 7  # unknowns that windows share: q, b, w


class Inertial(NamedTuple):
    """What an inertial measurement unit has measured, in its own axes."""

    times: Float[np.ndarray, "m"]  # seconds, ascending
    rates: Float[np.ndarray, "m 3"]  # rad/s
    accelerations: Float[np.ndarray, "m 3"]  # m/s²; of a unit at rest 9.81 upwards


class Motion(NamedTuple):
    """Scale of a path and what is up."""

    scale: Scale
    up: Float[np.ndarray, "3"]  # unit vector in the world
    up_std_deg: float
    gyroscope_bias: Float[np.ndarray, "3"]  # rad/s
    accelerometer_bias: Float[np.ndarray, "3"]  # m/s²
    late: float  # seconds that the frames' clock was ahead of the unit's; 0 unless it is surely so


class Window(NamedTuple):
    """A window's equations x = M θ of its positions; θ is q, b, w, γ."""

    times: Float[np.ndarray, "k"]  # of its frames, from 0
    matrix: Float[np.ndarray, "k 3 10"]
    positions: Float[np.ndarray, "k 3"]


def read_inertial(given: str) -> Inertial:
    """Read what a unit measured: a file with a line for each time, or a bag of ROS.

    Args:
        given: a file of time, three rates and three accelerations a line, with commas or spaces, such as EuRoC's
            imu0/data.csv; a bag with one topic of sensor_msgs/Imu; or BAG:/TOPIC.

    Raises:
        ValueError: there is no such file, a line has other numbers, times do not ascend, rates are all 0, or
            accelerations are without gravity.
    """
    name, _, topic = given.partition(":/")
    path = Path(name).expanduser()
    if is_bag(path):
        table = read_imu(path, f"/{topic}" if topic else None)
    else:
        path = Path(given).expanduser()
        table = _table_of(path)
    if len(table) < 10 or (np.diff(table[:, 0]) <= 0).any() or not np.isfinite(table).all():
        raise ValueError(
            f"{given} must have ten measurements or more with ascending times, and has {len(table)} with numbers"
        )
    length = float(np.median(np.linalg.norm(table[:, 4:], axis=1)))
    if not 0.7 * GRAVITY <= length <= 1.4 * GRAVITY:
        raise ValueError(
            f"{given}: the accelerations are {length:.3g} long, in the median, and should be near {GRAVITY}: give what "
            "the unit measures, gravity included, in m/s² (1 g = 9.81), in the columns time, rates, accelerations"
        )
    if not table[:, 1:4].any():
        raise ValueError(f"{given}: all rates are 0: give one file or topic with rates and accelerations")
    return Inertial(in_seconds(table[:, 0]), table[:, 1:4], table[:, 4:])


def _table_of(path: Path) -> Float[np.ndarray, "m 7"]:
    if not path.is_file():
        raise ValueError(f"scale.imu={path} is no file: give one with time, rates and accelerations a line, or a bag")
    rows = []
    for number, line, words in words_of(path):
        values = numbers_in(words[:7])
        if values is None and not rows:  # a heading
            continue
        if values is None or len(values) < 7 or not np.isfinite(values).all():
            raise ValueError(
                f"{path}, line {number}: expected a time, three rates (rad/s) and three accelerations (m/s²), got "
                f"{line!r}"
            )
        rows.append(values)
    return np.array(rows, np.float64).reshape(-1, 7)


def scale_of_motion(
    times: Float[np.ndarray, "n"],
    T_world_camera: Float[np.ndarray, "n 4 4"],
    measured: Inertial,
    T_imu_camera: Float[np.ndarray, "4 4"],
    source: str,
) -> Motion:
    """Find scale, gravity and biases of a path.

    Args:
        times: of the frames in seconds, ascending, by the clock of the unit or within `MAX_LATE` of it.
        T_world_camera: their poses, in any unit of length.
        T_imu_camera: camera → unit, metres.

    Raises:
        ValueError: fewer than `MIN_SECONDS` of the path were measured, or its accelerations are not those measured.
    """
    late = _late(times, Rotation.from_matrix(T_world_camera[:, :3, :3] @ T_imu_camera[:3, :3].T), measured)
    times = times - late
    is_inside, parts = frames_measured(times, measured, source)
    at, poses = times[is_inside], T_world_camera[is_inside]
    dense, frames = _with_frames(measured, at)
    rotations = Rotation.from_matrix(poses[:, :3, :3] @ T_imu_camera[:3, :3].T)
    arms = poses[:, :3, :3] @ -(T_imu_camera[:3, :3].T @ T_imu_camera[:3, 3])
    bias = _gyroscope_bias(dense, frames, rotations)
    turns = [_turned(dense, bias + step) for step in (np.zeros(3), *(BIAS_STEP * np.eye(3)))]
    _check_turns(rotations, turns[0][frames], parts, source)
    windows = [_window(dense, turns, frames[rows], poses[rows, :3, 3], rotations[rows], arms[rows]) for rows in parts]
    solved = _solve(windows)
    if solved is None:
        raise ValueError(
            f"{source}: the accelerations are not those of this path: check T_imu_camera, the axes and the clock"
        )
    unknowns, std, up, up_std = solved
    if std > MAX_STD:
        raise ValueError(
            f"{source}: the accelerations tell no scale (± {100 * std:.0f} %): the path is too short or too even, or "
            "they are not of it"
        )
    return Motion(Scale(source, -float(unknowns[0]), std), up, up_std, bias + unknowns[4:7], unknowns[1:4], late)


def frames_measured(
    times: Float[np.ndarray, "n"], measured: Inertial, source: str
) -> tuple[Bool[np.ndarray, "n"], list[np.ndarray]]:
    """Which frames were measured, and the rows among these of each window; ValueError for less than `MIN_SECONDS`."""
    is_inside = (times >= measured.times[0]) & (times <= measured.times[-1])
    at = times[is_inside]
    parts = _windows(at)
    if sum(float(np.ptp(at[rows])) for rows in parts) < MIN_SECONDS:
        raise ValueError(
            f"{source}: of {len(times)} frames at {_span(times)} too few are within {_span(measured.times)} and less "
            f"than {MAX_GAP:g} s apart for {MIN_SECONDS:g} s: times must be by the clock of the images, in seconds"
        )
    return is_inside, parts


def _span(times: Float[np.ndarray, "n"]) -> str:
    return f"{times[0]:.3f} to {times[-1]:.3f} s" if len(times) else "no time"


def _late(times: Float[np.ndarray, "n"], rotations: Rotation, measured: Inertial) -> float:
    """Seconds by which the frames' clock is ahead of the unit's; 0 unless that is surely so.

    From frame to frame both turn alike, but for a bias. Where the sum of squares J of what is left has its least, σ² of
    the seconds is 2 J / (k J″) with k residuals.
    """
    is_inside = (times >= measured.times[0] + MAX_LATE) & (times <= measured.times[-1] - MAX_LATE)
    if is_inside.sum() < MIN_FRAMES:
        return 0.0
    times, rotations = times[is_inside], rotations[is_inside]
    seconds, turned = np.diff(times), Slerp(measured.times, _turned(measured, np.zeros(3)))
    near = seconds <= MAX_GAP
    steps, seconds = (rotations[:-1].inv() * rotations[1:]).as_rotvec()[near], seconds[near, None]

    def left(late: float) -> float:
        at = turned(np.clip(times - late, measured.times[0], measured.times[-1]))
        off = (at[:-1].inv() * at[1:]).as_rotvec()[near] - steps
        return float(np.sum((off - seconds * off.sum(axis=0) / seconds.sum()) ** 2))

    tried = np.arange(-MAX_LATE, MAX_LATE + LATE_STEP / 2, LATE_STEP)
    sums = np.array([left(late) for late in tried])
    best = int(sums.argmin())
    if not 0 < best < len(tried) - 1:
        return 0.0
    before, least, after = sums[best - 1 : best + 2]
    bend = (before - 2 * least + after) / LATE_STEP**2
    late, std = tried[best] + (before - after) / (2 * bend * LATE_STEP), (2 * least / (steps.size * bend)) ** 0.5
    return float(late) if abs(late) > 3 * std else 0.0


def _windows(times: Float[np.ndarray, "n"]) -> list[np.ndarray]:
    """Rows of the frames of each window."""
    stretches = np.split(np.arange(len(times)), np.flatnonzero(np.diff(times) > MAX_GAP) + 1)
    parts = [
        part
        for rows in stretches
        if len(rows)
        for part in np.array_split(rows, max(round(float(np.ptp(times[rows])) / WINDOW), 1))
    ]
    return [part for part in parts if len(part) >= MIN_FRAMES]


def _with_frames(measured: Inertial, at: Float[np.ndarray, "n"]) -> tuple[Inertial, np.ndarray]:
    """Measurements from the first frame to the last, interpolated at each frame, and the frames' rows."""
    inner = measured.times[(measured.times > at[0]) & (measured.times < at[-1])]
    times = np.union1d(inner, at)
    rates, accelerations = (
        np.stack([np.interp(times, measured.times, column) for column in values.T], axis=1)
        for values in (measured.rates, measured.accelerations)
    )
    return Inertial(times, rates, accelerations), np.searchsorted(times, at)


def _turned(dense: Inertial, bias: Float[np.ndarray, "3"]) -> Rotation:
    """Orientation at each time relative to the first by the rates, as prefix products in log₂ steps."""
    rates, seconds = dense.rates - bias, np.diff(dense.times)
    steps = Rotation.from_rotvec(np.vstack([np.zeros(3), 0.5 * (rates[1:] + rates[:-1]) * seconds[:, None]]))
    shift = 1
    while shift < len(steps):
        steps = Rotation.concatenate([steps[:shift], steps[:-shift] * steps[shift:]])
        shift *= 2
    return steps


def _gyroscope_bias(dense: Inertial, frames: np.ndarray, rotations: Rotation) -> Float[np.ndarray, "3"]:
    """Bias (rad/s) by which the rates turn too far between consecutive frames, in two iterations."""
    bias, seconds = np.zeros(3), np.diff(dense.times[frames])
    near = seconds <= MAX_GAP
    for _ in range(2):
        turned = _turned(dense, bias)[frames]
        too_far = (rotations[:-1].inv() * rotations[1:]).inv() * (turned[:-1].inv() * turned[1:])
        bias = bias + too_far.as_rotvec()[near].sum(axis=0) / seconds[near].sum()
    return bias


def _check_turns(rotations: Rotation, turned: Rotation, parts: Sequence[np.ndarray], source: str) -> None:
    """ValueError if the rates turn the windows' frames otherwise than their rotations: the scale would be anything."""

    def spread(turns: Sequence[Rotation]) -> float:
        squares = [(one.mean().inv() * one).magnitude() ** 2 for one in turns]
        return float(np.degrees(np.sqrt(np.mean(np.concatenate(squares)))))

    off, of = spread([rotations[rows] * turned[rows].inv() for rows in parts]), spread([rotations[r] for r in parts])
    if off > max(MAX_TURNED_OFF[0], MAX_TURNED_OFF[1] * of):
        raise ValueError(
            f"{source}: the frames turn by {of:.0f}° and the rates otherwise, by {off:.0f}°: check that T_imu_camera "
            "turns the camera's axes into the unit's (its inverse, unit → camera, is what Kalibr writes), that rates "
            "are in rad/s, and that both have one clock"
        )


def _window(
    dense: Inertial,
    turns: Sequence[Rotation],
    frames: np.ndarray,
    positions: Float[np.ndarray, "k 3"],
    rotations: Rotation,
    arms: Float[np.ndarray, "k 3"],
) -> Window:
    """The equations of a window's positions.

    Args:
        turns: orientations by the rates, and by rates with one more step of bias in each axis.
    """
    rows = slice(frames[0], frames[-1] + 1)
    times = dense.times[rows] - dense.times[frames[0]]
    T_world_first = (rotations * turns[0][frames].inv() * turns[0][frames[0]]).mean()
    turn, *others = ((T_world_first * turned[frames[0]].inv() * turned[rows]).as_matrix() for turned in turns)
    pushed, *steps = (np.einsum("tij,tj->ti", one, dense.accelerations[rows]) for one in (turn, *others))
    changed = np.stack([(step - pushed) / BIAS_STEP for step in steps], axis=-1)
    integrals = np.concatenate([pushed[..., None], -turn, -changed], axis=-1)  # of R a, R, and dR a / dw
    for _ in range(2):
        integrals = cumulative_trapezoid(integrals, times, axis=0, initial=0)
    at = frames - frames[0]
    tau, gained = times[at], integrals[at]
    gained[..., 0] -= arms
    return Window(tau, np.concatenate([gained, 0.5 * tau[:, None, None] ** 2 * np.eye(3)], axis=-1), positions)


def _whitened(window: Window, noise: float, q: float) -> tuple[Float[np.ndarray, "j 10"], Float[np.ndarray, " j"]]:
    """M and x with errors of unit variance, without what the window's own c and v explain.

    Args:
        noise: of its positions, metres.
        q: units of a metre, about.
    """
    tau = window.times
    u = np.arange(0.0, tau[-1] + ERROR_STEP, ERROR_STEP)
    reach = np.maximum(tau[:, None] - u, 0.0) * ERROR_STEP  # double integral of a push at u
    together = np.exp(-np.abs(u[:, None] - u) / ERROR_TIME)
    covariance = noise**2 * np.eye(len(tau)) + ERROR_STD**2 * reach @ together @ reach.T
    white = np.linalg.inv(q * np.linalg.cholesky(covariance))
    own, _ = np.linalg.qr(white @ np.stack([np.ones_like(tau), tau], axis=1), mode="complete")
    white = own[:, 2:].T @ white
    matrix, positions = (np.einsum("jk,k...->j...", white, part) for part in (window.matrix, window.positions))
    return matrix.reshape(-1, matrix.shape[-1]), positions.reshape(-1)


class Equations(NamedTuple):
    """All windows' equations in a triangle: x = R θ with unit variance, and the root mean square of what is left."""

    triangle: Float[np.ndarray, "u u"]
    target: Float[np.ndarray, " u"]
    left: float


def _equations(windows: Sequence[Window], noise: float, q: float) -> Equations:
    parts = [_whitened(window, noise, q) for window in windows]
    count = SHARED + 3 * len(windows)
    blocks = []
    for number, (matrix, _) in enumerate(parts):
        block = np.zeros((len(matrix), count))
        block[:, :SHARED], own = matrix[:, :SHARED], SHARED + 3 * number
        block[:, own : own + 3] = matrix[:, SHARED:]
        blocks.append(block)
    positions = np.concatenate([part for _, part in parts])
    basis, triangle = np.linalg.qr(np.concatenate(blocks))
    target = basis.T @ positions
    degrees = max(len(positions) - count, 1)
    return Equations(triangle, target, float(np.linalg.norm(positions - basis @ target)) / degrees**0.5)


def _solve(windows: Sequence[Window]) -> tuple[np.ndarray, float, Float[np.ndarray, "3"], float] | None:
    """Solve for all unknowns.

    Returns:
        log q, b, w; the standard deviation of log q; up; its standard deviation in degrees. None without a solution.
    """
    found, q = None, 1.0
    for _ in range(2):  # of the unit in which errors are said
        for noise in NOISES:
            one = _equations(windows, noise, q)
            if one.left <= 1.0:
                break
        start = _free(one, len(windows)) if found is None else found.x
        if start is None:
            return None
        found = _bound(one, len(windows), start)
        q = float(np.exp(found.x[0]))
    covariance = np.linalg.pinv(found.jac.T @ found.jac) * max(one.left, 1.0) ** 2
    fall = found.x[SHARED:].reshape(-1, 3)
    up = -fall.sum(axis=0) / np.linalg.norm(fall.sum(axis=0))
    angles = np.linalg.norm(np.cross(fall, up), axis=1) / np.linalg.norm(fall, axis=1)
    shares = np.diagonal(covariance)[SHARED:].reshape(-1, 3).sum(axis=1).mean() / GRAVITY**2
    up_std = np.degrees(np.sqrt((np.mean(angles**2) + shares) / len(windows)))
    return found.x[:SHARED], float(np.sqrt(covariance[0, 0])), up, float(up_std)


def _free(equations: Equations, count: int) -> np.ndarray | None:
    """A start: the linear solution, with the unit by the length of gravity."""
    free = np.linalg.lstsq(equations.triangle, equations.target, rcond=1e-9)[0]
    fallen = free[SHARED:].reshape(count, 3)
    q = float(np.linalg.norm(fallen, axis=1).mean()) / GRAVITY
    return np.concatenate([[np.log(q)], np.zeros(SHARED - 1), (fallen / q).reshape(-1)]) if q > 0 else None


def _bound(equations: Equations, count: int, start: np.ndarray) -> OptimizeResult:
    """Solve for log q, b, w and each γ / q, with priors of the biases and of the length of gravity."""

    def misfit(x: np.ndarray) -> np.ndarray:
        lengths = np.linalg.norm(x[SHARED:].reshape(count, 3), axis=1)
        theta = np.exp(x[0]) * np.concatenate([[1.0], x[1:]])
        priors = (lengths - GRAVITY) / GRAVITY_STD, x[1:4] / BIASES_STD[0], x[4:SHARED] / BIASES_STD[1]
        return np.concatenate([equations.triangle @ theta - equations.target, *priors])

    return least_squares(misfit, start, x_scale="jac")

"""The covariance of a pose relative to the first frame: against samples of the errors of a walk that comes back."""

from dataclasses import replace

import jaxlie
import numpy as np
import pytest
from hand_run import atlas_of
from scene import on_host, pose

from emgs_jax.back_end.state import BackEnd
from emgs_jax.geometry import seen_from
from emgs_jax.mapping.records import FrameRecord
from emgs_jax.mapping.tracking import covariance_of_map
from tools.nees import nees, pose_errors

COUNT, NUM_DRAWS = 12, 4000
ORIGINS = (None, 0, 0, 1, 3, 4, 4, 6, 7, 2, 0, 9)  # on the way out the frames before; then what was seen on it
OWN = np.diag([0.02, 0.01, 0.03, 0.002, 0.004, 0.001]) ** 2  # of each frame in the map


def walk() -> np.ndarray:
    """Poses (12, 4, 4) around a circle of 3 m."""
    return np.stack(
        [np.asarray(pose((0.0, -0.5 * i, 0.1), (3 * np.sin(0.5 * i), 0.2, 3 * np.cos(0.5 * i))).as_matrix(), float)
         for i in range(COUNT)]
    )  # fmt: skip


def mapped(origins=ORIGINS) -> list[FrameRecord]:
    records = []
    for row, (T, origin) in enumerate(zip(walk(), origins, strict=True)):
        covariance = None if row == 0 else OWN + covariance_of_map(graph_of(records), T, origin)
        status = "tracked" if row else "initialization"
        records.append(FrameRecord(row, None, None, status, pose=T, covariance=covariance, origin=origin))
    return records


def graph_of(records) -> BackEnd:
    return atlas_of(records).graph


def test_errors_that_add_up_from_origin_to_origin_have_the_covariance_that_is_said():
    """Each frame errs relative to where the frame really was whose part of the map it was placed in."""
    poses, records, rng = walk(), mapped(), np.random.default_rng(0)
    true = np.empty((COUNT, NUM_DRAWS, 4, 4))
    true[0] = poses[0]
    exp = on_host(lambda xi: jaxlie.SE3.exp(xi).as_matrix())
    for row in range(1, COUNT):
        own = np.asarray(exp(np.float32(rng.multivariate_normal(np.zeros(6), OWN, NUM_DRAWS))), float)
        true[row] = true[ORIGINS[row]] @ np.linalg.inv(poses[ORIGINS[row]]) @ poses[row] @ own
    for row in range(1, COUNT):
        errors = pose_errors(np.broadcast_to(poses[row], (NUM_DRAWS, 4, 4)), true[row])
        said = np.broadcast_to(records[row].covariance, (NUM_DRAWS, 6, 6))
        assert nees(errors, said).mean() == pytest.approx(1.0, abs=0.05), row
    std = [np.sqrt(np.trace(record.covariance[:3, :3])) for record in records[1:]]
    assert std[7] > 1.5 * std[0] and std[9] == pytest.approx(std[0], rel=0.01)  # out, and back where it began


def test_a_frame_that_nothing_explains_has_the_origin_of_the_frame_before():
    """Not tracked, or tracked and all it sees is new: its origin is its own number then."""
    before = graph_of(mapped()[:9])
    T, there = walk()[9], before.nodes[7]  # of the frame before, 8
    expected = seen_from(there.covariance, there.pose, T[None])[0]
    for origin in (None, 9):
        np.testing.assert_array_equal(covariance_of_map(before, T, origin), expected)
    np.testing.assert_array_equal(covariance_of_map(graph_of(mapped()[:1]), walk()[1], None), np.zeros((6, 6)))


def test_a_saved_map_is_exact_and_what_a_run_adds_to_it_is_not():
    """Of 20 frames."""
    saved, added = ([replace(one, covariance=None, origin=None) for one in mapped()] * 2)[:20], mapped()[1:5]
    graph, T = graph_of([*saved, *added]), walk()[6]
    for origin in (0, 19):
        np.testing.assert_array_equal(covariance_of_map(graph, T, origin), np.zeros((6, 6)))
    expected = seen_from(added[1].covariance, added[1].pose, T[None])[0]
    np.testing.assert_array_equal(covariance_of_map(graph, T, 21), expected)

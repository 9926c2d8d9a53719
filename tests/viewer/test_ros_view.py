"""What is published to ROS 2, without ROS: clouds, what changed in them, and the odometry of a frame."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.gaussian_map import empty_map
from emgs_jax.mapping.records import FrameRecord
from emgs_jax.viewer.ros import changed_rows, cloud_of, odometry_of


def a_map(means, colors, existence, capacity: int = 4):
    """A map whose first rows are Gaussians with these values."""
    rows, map = len(means), empty_map(capacity, 0)
    return eqx.tree_at(
        lambda m: (m.gaussians.means, m.gaussians.colors, m.gaussians.valid, m.existence),
        map,
        (
            map.gaussians.means.at[:rows].set(jnp.asarray(means, jnp.float32)),
            map.gaussians.colors.at[:rows].set(jnp.asarray(colors, jnp.float32)),
            jnp.arange(capacity) < rows,
            map.existence.at[:rows].set(jnp.asarray(existence, jnp.float32)),
        ),
    )


MEANS, COLORS = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.5]]


def xyz(rows) -> np.ndarray:
    return np.stack([rows["point"][name] for name in "xyz"], axis=1)


def test_a_cloud_has_the_confirmed_gaussians_in_the_frame_of_the_map_with_their_colours():
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("z", 90, degrees=True).as_matrix(), (10, 0, 0)
    rows = cloud_of(a_map(MEANS, COLORS, [1.0, -1.0, 1.0]), T)
    assert rows["is_shown"].tolist() == [True, False, True, False]
    np.testing.assert_allclose(xyz(rows[rows["is_shown"]]), [[8, 1, 3], [2, 7, 9]], atol=1e-5)
    assert [hex(value) for value in rows["point"]["rgb"][[0, 2]]] == ["0xff0000", "0x80"]


def test_only_what_changed_is_sent_again_also_where_the_map_has_grown():
    first = cloud_of(a_map(MEANS[:2], COLORS[:2], [1.0, 1.0], 2), np.eye(4))
    assert len(changed_rows(first, None)) == 2 and len(changed_rows(first, first)) == 0
    moved = [[1.5, 2.0, 3.0], *MEANS[1:]]
    later = cloud_of(a_map(moved, COLORS, [1.0, 1.0, 1.0]), np.eye(4))
    np.testing.assert_array_equal(xyz(changed_rows(later, first)), [moved[0], moved[2]])
    gone = cloud_of(a_map(MEANS[:2], COLORS[:2], [1.0, -1.0], 2), np.eye(4))
    assert len(changed_rows(gone, first)) == 0, "the whole cloud tells of what is gone"


def test_the_odometry_of_a_frame_is_what_came_with_its_image(tmp_path):
    T = np.eye(4)
    T[0, 3] = 2.0
    for name, pose in (("known", T), ("lost", np.full((4, 4), np.nan))):
        np.savez(tmp_path / f"{name}.npz", T_world_camera=pose)
    records = {
        name: FrameRecord(0, str(tmp_path / f"{name}.png"), 0.0, "tracked") for name in ("known", "lost", "none")
    }
    np.testing.assert_array_equal(odometry_of(records["known"]), T)
    assert odometry_of(records["lost"]) is None and odometry_of(records["none"]) is None
    assert odometry_of(FrameRecord(0, None, 0.0, "tracked")) is None

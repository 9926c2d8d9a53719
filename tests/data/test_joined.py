"""Several data sets as one: a camera that shows what all show, and frames as that camera sees them."""

import numpy as np
import pytest

from emgs_jax.data.joined import JoinedFrames, common_camera
from emgs_jax.data.synthetic import Synthetic

FIRST, SECOND = Synthetic(num_frames=4, stop=2, size=[64, 48]), Synthetic(num_frames=4, start=2, size=[128, 96])
WIDE = ((64, 48), (40.0, 40.0, 31.5, 23.5))


@pytest.mark.parametrize(
    ("others", "size", "center"),
    [
        ([WIDE], (64, 48), (31.5, 23.5)),
        ([((128, 96), (80.0, 80.0, 63.5, 47.5))], (64, 48), (31.5, 23.5)),  # the same lens, twice the pixels
        ([((64, 48), (80.0, 60.0, 31.5, 23.5))], (32, 32), (15.5, 15.5)),  # sees half of it, two thirds of it
        ([((64, 48), (40.0, 40.0, 41.5, 23.5))], (54, 48), (31.5, 23.5)),  # sees less on the right
    ],
)
def test_the_common_camera_shows_what_all_show_with_the_focal_lengths_of_the_first(others, size, center):
    found, intrinsics = common_camera([WIDE, *others])
    assert found == size
    np.testing.assert_allclose(intrinsics, (40.0, 40.0, *center), atol=1e-6)


def test_cameras_that_show_nothing_in_common_are_refused():
    with pytest.raises(ValueError, match="nothing in common"):
        common_camera([WIDE, ((64, 48), (40.0, 40.0, 131.5, 23.5))])


def test_a_frame_of_another_size_is_what_the_common_camera_sees():
    joined = JoinedFrames([FIRST, SECOND])
    assert len(joined) == 4 and joined.size == (64, 48) and joined.intrinsics == FIRST.intrinsics
    np.testing.assert_array_equal(joined[1].image, FIRST[1].image)
    as_one = Synthetic(num_frames=4, size=[64, 48])[2]
    seen = joined[2]
    assert seen.index == 2 and seen.image.shape == (48, 64, 3)
    np.testing.assert_array_equal(seen.T_world_camera, as_one.T_world_camera)
    far = np.abs(seen.depth - as_one.depth) > 0.02 * as_one.depth
    assert far.mean() < 0.1, "but for edges, and what is slanted: the nearest pixel is half of one off"
    assert np.median(np.abs(seen.image.astype(int) - as_one.image)) <= 4


def test_truth_of_several_worlds_is_left_out():
    joined = JoinedFrames([FIRST, SECOND], has_truth=False)
    assert not joined.has_ground_truth and joined.pose(0) is None and joined[3].depth is None
    assert joined.fingerprint() != JoinedFrames([FIRST, SECOND]).fingerprint()

"""What was taken for moving: tinted in images, black in masks, said in the line of a frame."""

import numpy as np
import pytest

from emgs_jax.runs.moving import frame_facts, moving_mask, with_moving

LEFT = {"size": [2, 4], "counts": [0, 2, 2, 2, 2]}  # of the thinned image
SIZE = (8, 4)


@pytest.mark.parametrize(("pixels", "share"), [(LEFT, 0.5), (None, 0.0)])
def test_moving_pixels_are_green_where_the_image_shows_them(pixels, share):
    line, image = {"index": 3, "moving": share, "moving_pixels": pixels}, np.full((4, 8, 3), 100, np.uint8)
    is_left = np.indices((4, 8))[1] < 8 * share
    np.testing.assert_array_equal(moving_mask(line, SIZE), is_left)
    tinted = with_moving(image, line)
    np.testing.assert_array_equal(tinted[~is_left], 100)
    assert (tinted[is_left, 1] > 150).all() and (tinted[is_left, 0] < 60).all()
    assert frame_facts(line) == ("50 % moving" if share else "")


@pytest.mark.parametrize("pixels", [{"size": [2, 4]}, {"size": [2, 4], "counts": [3]}, {"size": 2, "counts": "ab"}])
def test_what_is_no_mask_is_named(pixels):
    with pytest.raises(ValueError, match="moving_pixels of frame 3 in frames.jsonl is no mask .*: run again"):
        moving_mask({"index": 3, "moving_pixels": pixels}, SIZE)

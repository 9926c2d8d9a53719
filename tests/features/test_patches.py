"""What the network sees: whole patches of the nearest aspect ratio, in normalised colours."""

import numpy as np
import pytest

from emgs_jax.features.images import ImageConfig, grid_size, network_input


def test_the_grid_is_the_one_of_the_nearest_aspect_ratio_and_a_side_of_broken_patches_is_refused():
    for size, patch, long_side, grid in (
        ((640, 480), 16, 640, (40, 30)),
        ((320, 240), 16, 1024, (64, 48)),
        ((640, 480), 14, 518, (37, 28)),  # MapAnything's 518x392
        ((1200, 680), 14, 518, (37, 21)),  # MapAnything's 518x294
        ((480, 640), 14, 518, (28, 37)),
        ((900, 10), 16, 64, (4, 1)),
    ):
        assert grid_size(size, patch, long_side) == grid
    for long_side in (8, 650):
        with pytest.raises(ValueError, match="long_side must be a multiple of the network's patch, 16; got"):
            grid_size((640, 480), 16, long_side)


def test_an_image_of_that_size_is_only_normalised():
    image = np.random.default_rng(0).integers(0, 256, (32, 48, 3), np.uint8)
    config = ImageConfig(48, [0.5, 0.4, 0.3], [0.2, 0.3, 0.4])
    expected = ((image / 255 - [0.5, 0.4, 0.3]) / [0.2, 0.3, 0.4]).transpose(2, 0, 1)
    values = network_input(image, (3, 2), 16, config)
    assert values.dtype == np.float32
    np.testing.assert_allclose(values, expected, atol=1e-5)


@pytest.mark.parametrize("size", [(24, 16), (96, 64)])
def test_resizing_keeps_borders_where_they_are(size):
    """A colour that is linear in the position stays so, under u' + ½ = (u + ½) W' / W, away from the borders."""
    width, height = size
    config = ImageConfig(48, [0, 0, 0], [1, 1, 1])
    ramp = np.broadcast_to(((np.arange(width) + 0.5) * 240 / width)[None, :, None], (height, width, 3))
    values = network_input(np.round(ramp).astype(np.uint8), (3, 2), 16, config)
    expected = (np.arange(48) + 0.5) * 240 / 48 / 255
    assert values.shape == (3, 32, 48)
    np.testing.assert_allclose(values[:, :, 6:-6], np.broadcast_to(expected[6:-6], (3, 32, 36)), atol=1.0 / 255)

"""Oracle: the camera of the device, which is tested by itself."""

import jax.numpy as jnp
import numpy as np

from emgs_jax.data.backprojection import backproject
from emgs_jax.ops.camera import Camera, unproject


def test_points_of_depth_images_are_those_of_the_camera_on_the_device():
    depth = np.random.default_rng(0).uniform(0.0, 5.0, (2, 5, 7)).astype(np.float32)
    intrinsics = (110.0, 95.0, 3.2, 1.7)
    camera = Camera(intrinsics[:2], intrinsics[2:], width=7, height=5)
    for points, image in zip(backproject(depth, intrinsics), depth, strict=True):
        np.testing.assert_allclose(points, unproject(camera, jnp.asarray(image)), atol=1e-6)

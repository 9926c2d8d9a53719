"""What METER is shown of a frame, and where what it says belongs."""

from types import SimpleNamespace

import cv2
import hydra
import numpy as np
from scene import compose

from emgs_jax.ops.camera import Camera
from emgs_jax.prior.multiview import monocular_network as module
from emgs_jax.prior.multiview.dense import Scene
from emgs_jax.prior.multiview.lens import Lens


def test_the_network_is_shown_the_whole_image_and_its_depths_lie_at_the_images_pixels(monkeypatch):
    """A network that says what is red in every fourth row and column."""
    monkeypatch.setattr(module, "load_network", lambda *given: None)
    monkeypatch.setattr(
        module, "jitted_predict", lambda network, image: cv2.resize(np.asarray(image)[..., 0], (64, 48))
    )
    monkeypatch.setattr(module, "begin_monocular", lambda scene, values, config: values)
    config = hydra.utils.instantiate(compose("prior=multiview_stereo", "prior/dense=meter").prior.dense)
    image = np.zeros((240, 400, 3), np.uint8)
    image[..., 0] = np.linspace(0, 255, 400)
    camera = Camera(np.float32([300, 300]), np.float32([200, 120]), 400, 240)
    lens = Lens(camera.focal, camera.center)
    frames, structure = [SimpleNamespace(image=image)], SimpleNamespace(world=np.array([0]))
    values = module.way_of_meter(config).begin(Scene(frames, structure, [lens], camera))(0)
    assert values.shape == (240, 400)
    np.testing.assert_allclose(values[:, 8:-8], image[:, 8:-8, 0] / 255, atol=0.01)

"""Depth by a network within the classical prior: the camera of its images, and with real weights a painted plane."""

import os
from pathlib import Path
from types import SimpleNamespace

import cv2
import hydra
import jax.numpy as jnp
import numpy as np
import pytest
from random_weights import random_network
from scene import compose
from stereo_scene import AROUND, sources

from emgs_jax.ops.camera import Camera, pixel_grid, rays
from emgs_jax.ops.pytree import stack
from emgs_jax.prior.multiview import learned as module
from emgs_jax.prior.multiview import monocular_network
from emgs_jax.prior.multiview.dense import Scene
from emgs_jax.prior.multiview.learned import grid_of, learned
from emgs_jax.prior.multiview.lens import Lens

pytestmark = pytest.mark.slow


BESIDE = Path(__file__).resolve().parents[3].parent
CHECKPOINT = Path(os.environ.get("ITERMVS_CHECKPOINT", BESIDE / "shared/weights/itermvs_blendedmvs_model_000015.ckpt"))
T_SOURCE_VIEW = np.linalg.inv(np.stack(AROUND))
ITERMVS = ("prior=multiview_stereo", "prior/dense=itermvs", "prior.dense.magnification=2.0")


def prior_node(*overrides):
    return compose(*ITERMVS, *overrides).prior


def camera():
    return Camera([110.0, 110.0], [63.5, 47.5], 128, 96)


def plane_view(T_world_camera, slope=0.4):
    """RGB image and depth of the plane z = 2 m + slope x, which has a fine random pattern."""
    directions = np.asarray(rays(camera(), pixel_grid(camera()))) @ T_world_camera[:3, :3].T
    normal = np.array([-slope, 0.0, 1.0])
    depth = (2.0 - normal @ T_world_camera[:3, 3]) / (directions @ normal)
    x, y = np.moveaxis(np.float32((T_world_camera[:3, 3] + depth[..., None] * directions)[..., :2]), -1, 0)
    pattern = np.random.default_rng(0).uniform(size=(512, 512, 3)).astype(np.float32)
    pattern = sum(cv2.GaussianBlur(pattern, (0, 0), width) * width for width in (2.0, 8.0)) - 4.5
    shown = cv2.remap(pattern, 60 * x + 256, 60 * y + 256, cv2.INTER_LINEAR)
    return np.uint8(np.clip(255 * shown, 0, 255)), depth


def estimate(stereo, T_source_view=T_SOURCE_VIEW):
    """What it says of a painted plane."""
    kept = [stereo.prepare(plane_view(T)[0], Lens([110.0] * 2, [63.5, 47.5])) for T in (np.eye(4), *AROUND)]
    seen = sources(None, np.linalg.inv(T_source_view))._replace(views=stack(kept[1:]))
    return stereo.estimate(kept[0], seen, jnp.asarray([1.2, 5.0]), camera())


@pytest.mark.parametrize(("magnification", "size"), [(1.0, (320, 256)), (2.0, (640, 480)), (0.01, (32, 32))])
def test_the_networks_images_have_sizes_that_it_takes_and_their_edges_are_those_of_the_view(magnification, size):
    camera = Camera([262.5, 263.0], [159.5, 118.0], 320, 240)
    grid = grid_of(camera, magnification)
    assert (grid.width, grid.height) == size
    for fraction in (0.0, 0.3, 1.0):  # of the way from edge to edge
        ends = [
            rays(shown, fraction * jnp.asarray([shown.width, shown.height], jnp.float32) - 0.5)
            for shown in (camera, grid)
        ]
        np.testing.assert_allclose(*ends, atol=1e-6)


def test_every_pixel_of_the_view_has_a_depth_within_the_range_and_a_spread_whatever_the_weights(monkeypatch):
    monkeypatch.setattr(module, "load_network", lambda *given: random_network())
    depth, spread = estimate(learned(hydra.utils.instantiate(prior_node().dense)))
    assert depth.shape == spread.shape == (96, 128)
    assert depth.min() >= 1.2 - 1e-5 and depth.max() <= 5 + 1e-5
    assert spread.min() >= 0 and np.isfinite(spread).all()


def test_settings_say_which_weights_and_not_where_they_lie(monkeypatch):
    monkeypatch.setattr(module, "load_network", lambda *given: random_network())
    priors = [
        hydra.utils.instantiate(prior_node(*words))
        for words in ((), ("prior.dense.checkpoint=elsewhere",), ("prior.dense.sha256=0f",))
    ]
    settings = [prior.provenance.settings for prior in priors]
    assert settings[0] == settings[1] != settings[2] and settings[2]["dense"]["sha256"] == "0f"


def test_without_its_file_the_prior_is_refused_with_the_place_where_it_is_published():
    with pytest.raises(hydra.errors.InstantiationException) as error:
        hydra.utils.instantiate(prior_node())
    assert "prior.dense.checkpoint=None" in str(error.value) and "github.com" in str(error.value)


@pytest.mark.skipif(not CHECKPOINT.is_file(), reason="the published weights are not beside this clone")
def test_a_painted_plane_has_its_depth():
    stereo = learned(hydra.utils.instantiate(prior_node(f"prior.dense.checkpoint={CHECKPOINT}").dense))
    truth = plane_view(np.eye(4))[1]
    error, turned = ((estimate(stereo, T)[0] / truth - 1)[8:-8, 8:-8] for T in (T_SOURCE_VIEW, AROUND))
    # So small an image it knows to some percent, but evenly; with poses the wrong way round it knows nothing.
    assert abs(np.median(error)) < 0.01 and np.median(np.abs(error)) < 0.05
    assert np.median(np.abs(turned)) > 0.15


def test_the_network_is_shown_the_whole_image_and_its_depths_lie_at_the_images_pixels(monkeypatch):
    """A network that says what is red in every fourth row and column."""
    monkeypatch.setattr(monocular_network, "load_network", lambda *given: None)
    monkeypatch.setattr(
        monocular_network, "jitted_predict", lambda network, image: cv2.resize(np.asarray(image)[..., 0], (64, 48))
    )
    monkeypatch.setattr(monocular_network, "begin_monocular", lambda scene, values, config: values)
    config = hydra.utils.instantiate(compose("prior=multiview_stereo", "prior/dense=meter").prior.dense)
    image = np.zeros((240, 400, 3), np.uint8)
    image[..., 0] = np.linspace(0, 255, 400)
    camera = Camera(np.float32([300, 300]), np.float32([200, 120]), 400, 240)
    lens = Lens(camera.focal, camera.center)
    frames, structure = [SimpleNamespace(image=image)], SimpleNamespace(world=np.array([0]))
    values = monocular_network.way_of_meter(config).begin(Scene(frames, lambda: structure, lambda world: lens, camera))(
        0
    )
    assert values.shape == (240, 400)
    # Centimetres by a camera of 207.7 pixels of focal length; this one has 192 and 240 in the network's image.
    metres = 0.01 * (192 * 240) ** 0.5 / 207.7
    np.testing.assert_allclose(values[:, 8:-8], metres * image[:, 8:-8, 0] / 255, atol=0.01 * metres)

"""IterMVS with random weights: what holds whatever they are; with the published ones: what its authors' code says.

The latter wants the published file beside this clone (`../shared/weights`, or ITERMVS_CHECKPOINT=FILE), the former's
code (`../IterMVS`, or ITERMVS=FOLDER) and PyTorch, and is skipped where one is missing.
"""

import hashlib
import os
import sys
from pathlib import Path

import hydra
import numpy as np
import pytest
import scipy.ndimage
from random_weights import random_network, random_tensors
from scene import compose, device, on_host
from views import BESIDE, RANGE, SIZE, asked, camera, random_views, real_views

from emgs_jax.prior.pretrained import itermvs
from emgs_jax.prior.pretrained.itermvs import SOURCE, build_network
from emgs_jax.prior.pretrained.layers import Conv, convolve, sample
from emgs_jax.prior.pretrained.weights import load_network

pytestmark = pytest.mark.slow


CHECKPOINT = Path(os.environ.get("ITERMVS_CHECKPOINT", BESIDE / "shared/weights/itermvs_blendedmvs_model_000015.ckpt"))
ORIGINAL = Path(os.environ.get("ITERMVS", BESIDE / "IterMVS"))
DENSE = hydra.utils.instantiate(compose("prior=multiview_stereo", "prior/dense=itermvs").prior.dense)
found = asked(itermvs, DENSE.network)


def load(checkpoint, sha256):
    return load_network(checkpoint, sha256, SOURCE, "model", build_network)


@pytest.fixture(scope="module")
def network():
    return random_network()


@pytest.fixture(scope="module")
def answer(network):
    return found(network, *random_views())


def test_every_pixel_has_a_depth_within_the_range_and_a_confidence(answer):
    depth, confidence = answer
    assert depth.shape == confidence.shape == SIZE
    assert depth.min() >= RANGE[0] - 1e-5 and depth.max() <= RANGE[1] + 1e-5 and depth.std() > 0
    assert confidence.min() > 0 and confidence.max() < 1


def test_a_source_that_does_not_count_changes_nothing_and_the_unit_is_free(network, answer):
    images, T = random_views()
    used = [True, False, True, True]
    before = found(network, images, T, is_used=used)
    poisoned, moved = images.copy(), T.copy()
    poisoned[2], moved[1, :3, 3] = 100.0, -50.0
    for a, b in zip(before, found(network, poisoned, moved, is_used=used), strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.abs(before[0] - answer[0]).max() > 1e-3  # it would
    T[:, :3, 3] *= 8.0
    depth, confidence = found(network, images, T, np.multiply(8.0, RANGE))
    # A factor of two to the third rounds nothing.
    np.testing.assert_allclose(depth, 8.0 * answer[0], rtol=1e-5)
    np.testing.assert_allclose(confidence, answer[1], atol=1e-5)


def test_a_transposed_convolution_is_the_adjoint_of_the_strided_one():
    """⟨A x, y⟩ = ⟨x, Aᵀ y⟩ for any x and y."""
    rng = np.random.default_rng(0)
    weight, x, y = (rng.normal(size=shape) for shape in ((3, 3, 2, 4), (8, 12, 2), (4, 6, 4)))
    down = Conv(device(weight), device(np.zeros(4)), 2, 1, 1)
    up = Conv(device(weight[::-1, ::-1].swapaxes(2, 3)), device(np.zeros(2)), 1, 1, 2)
    left, right = on_host(convolve)(device(x), down) * y, x * on_host(convolve)(device(y), up)
    assert left.sum() == pytest.approx(right.sum(), rel=1e-4)


def test_samples_are_linear_between_pixels_and_zero_beyond_the_image():
    rng = np.random.default_rng(0)
    image, pixels = rng.normal(size=(7, 9, 2)), rng.uniform(-3, 12, (200, 2))
    pixels[:2] = (1e12, -1e12), (-np.inf, 3)
    seen = rng.uniform(size=200) < 0.8
    at, channels = np.clip(pixels[:, ::-1], -99, 99).T, np.moveaxis(image, -1, 0)
    known = [scipy.ndimage.map_coordinates(channel, at, order=1, mode="grid-constant") for channel in channels]
    values = on_host(sample)(device(image), device(pixels), seen)
    np.testing.assert_allclose(values, np.where(seen, known, 0.0).T, atol=1e-5)


def test_weights_that_are_missing_or_others_are_refused_by_name(tmp_path):
    other = tmp_path / "other.ckpt"
    other.write_bytes(b"nothing")
    digest = DENSE.sha256
    with pytest.raises(ValueError, match=r"prior.dense.checkpoint=None .* https://github.com/FangjinhuaWang/IterMVS"):
        load(None, digest)
    with pytest.raises(ValueError, match=f"SHA-256 {_digest(other)}, expected {digest}"):
        load(str(other), digest)
    with pytest.raises(ValueError, match="has not the weights of https://github.com/FangjinhuaWang/IterMVS"):
        load(str(other), _digest(other))
    tensors = random_tensors()
    del tensors["module.iter_mvs.update.gru.convr.bias"], tensors["module.iter_mvs.upsample.2.weight"]
    with pytest.raises(KeyError, match=r"iter_mvs.upsample.2.weight"):
        build_network(tensors)


def _digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def published():
    if not CHECKPOINT.is_file():
        pytest.skip(f"the published weights are not at {CHECKPOINT}")
    return load(str(CHECKPOINT), DENSE.sha256)


def original(images, T_source_view, size):
    """Depth and confidence of the authors' code."""
    torch = pytest.importorskip("torch", reason="torch is not installed")
    if not (ORIGINAL / "models/net.py").is_file():
        pytest.skip(f"the code of IterMVS is not at {ORIGINAL}: git clone https://github.com/FangjinhuaWang/IterMVS")
    sys.path.insert(0, str(ORIGINAL))
    try:
        from models.net import Pipeline
    finally:
        sys.path.remove(str(ORIGINAL))
    state = torch.load(CHECKPOINT, map_location="cpu", weights_only=True)["model"]
    network = Pipeline(test=True).eval()
    network.load_state_dict({name.removeprefix("module."): value for name, value in state.items()})
    shown, T = camera(size), np.concatenate([np.eye(4)[None], T_source_view])
    K = np.diag([*np.asarray(shown.focal), 1.0])
    K[:2, 2] = shown.center
    projections = {}
    for level in (1, 2, 3):
        P = T.copy()
        P[:, :3] = np.diag([0.5**level, 0.5**level, 1.0]) @ K @ T[:, :3]
        projections[f"level_{level}"] = torch.tensor(P[None], dtype=torch.float32)
    shown = torch.tensor(2.0 * images.transpose(0, 3, 1, 2)[None] - 1.0)
    with torch.no_grad():
        found = network({"level_0": shown, "level_2": shown}, projections, *(torch.tensor([end]) for end in RANGE))
    return tuple(found[name][0, 0].numpy() for name in ("depths_upsampled", "confidence_upsampled"))


@pytest.mark.parametrize("kind", ["random", "real"])
def test_depth_and_confidence_are_those_of_the_authors_code(published, kind):
    size = (128, 160)
    images, T = random_views(size) if kind == "random" else real_views(size)
    known = original(images, T, size)
    depth, confidence = found(published, images, T)
    # In float64 all pixels are the same to 7e-8. In float32 two bins may be equally probable but for the rounding, and
    # around such a pixel both go on otherwise.
    for values, truth in ((depth / known[0], 1.0), (confidence, known[1])):
        assert np.mean(np.abs(values - truth) > 1e-4) < 0.15 and np.median(np.abs(values - truth)) < 1e-5

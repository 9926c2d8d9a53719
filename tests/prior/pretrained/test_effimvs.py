"""Effi-MVS+ with the published weights: what its authors' code says, and what holds beyond it.

The weights and the code are those of a clone beside this one (`../Effi-MVS-plus`, or EFFIMVS=FOLDER); the comparison
wants PyTorch as well. Skipped where one is missing.
"""

import os
import sys
from argparse import Namespace
from pathlib import Path
from types import SimpleNamespace

import hydra
import jax
import numpy as np
import pytest
from scene import compose
from views import BESIDE, RANGE, asked, camera, random_views, real_views

from emgs_jax.prior.pretrained import effimvs
from emgs_jax.prior.pretrained.effimvs import SOURCE, build_network
from emgs_jax.prior.pretrained.weights import load_network

ORIGINAL = Path(os.environ.get("EFFIMVS", BESIDE / "Effi-MVS-plus"))
CHECKPOINT = ORIGINAL / "checkpoints/Effi_MVS_plus/model_tank.ckpt"
SIZE = (128, 160)
DENSE = hydra.utils.instantiate(compose("prior=multiview_stereo", "prior/dense=effimvs").prior.dense)
found = asked(effimvs, DENSE.network)


@pytest.fixture(scope="module")
def network():
    if not CHECKPOINT.is_file():
        pytest.skip(f"the published weights are not at {CHECKPOINT}")
    return load_network(str(CHECKPOINT), DENSE.sha256, SOURCE, "model", build_network)


def original(images, T_source_view):
    """Depth of the authors' code, and its confidence at an eighth of the size."""
    torch = pytest.importorskip("torch", reason="torch is not installed")
    others = {name: sys.modules.pop(name) for name in ("models", "utils") if name in sys.modules}
    sys.path.insert(0, str(ORIGINAL))
    sys.modules["utils"] = SimpleNamespace(local_pcd=None)  # which wants packages for files of clouds
    try:
        from models.Effi_MVS_plus import Effi_MVS_plus
    finally:
        sys.path.remove(str(ORIGINAL))
        for name in ("models", "utils"):
            sys.modules.pop(name, None)
        sys.modules.update(others)
    network = Effi_MVS_plus(Namespace(ndepths="96,8,8", GRUiters="3,3,3", CostNum=3)).eval()
    network.load_state_dict(torch.load(CHECKPOINT, map_location="cpu", weights_only=True)["model"])
    shown, T = camera(SIZE), np.concatenate([np.eye(4)[None], T_source_view])
    K = np.diag([*np.asarray(shown.focal), 1.0, 1.0])
    K[:2, 2] = shown.center
    projections = {}
    for stage, scale in ((1, 8), (2, 4), (3, 2)):
        both = np.stack([T, np.broadcast_to(np.diag([1 / scale, 1 / scale, 1, 1]) @ K, T.shape)], axis=1)
        projections[f"stage{stage}"] = torch.tensor(both[None], dtype=torch.float32)
    inverse = torch.linspace(1 / RANGE[1], 1 / RANGE[0], DENSE.network.num_steps)[None]
    with torch.no_grad():
        said = network(torch.tensor(images.transpose(0, 3, 1, 2)[None]), projections, inverse)
    return said["depth"][-1][0].numpy(), said["photometric_confidence"][0, ::4, ::4].numpy()


def test_depth_and_confidence_are_those_of_the_authors_code(network):
    images, T = real_views(SIZE)
    depth, confidence = found(network, images, T)
    known_depth, known = original(images, T)
    known = jax.image.resize(known[..., None], (*SIZE, 1), "linear", antialias=False)[..., 0]
    # In float64 all pixels of the real views are the same to 7e-5. In float32 roundings add up where little is known.
    error = np.abs(depth / known_depth - 1)
    assert np.mean(error > 1e-4) < 0.05 and np.median(error) < 1e-5
    np.testing.assert_allclose(confidence, known, atol=1e-4)


def test_a_source_that_does_not_count_changes_nothing_and_the_unit_is_free(network):
    images, T = random_views()
    used = [True, False, True, True]
    before = found(network, images, T, is_used=used)
    poisoned, moved = images.copy(), 8.0 * T
    poisoned[2], moved[1, :3, 3] = 100.0, -50.0
    moved[:, :3, :3], moved[:, 3, 3] = T[:, :3, :3], 1.0
    depth, confidence = found(network, poisoned, moved, np.multiply(8.0, RANGE), used)
    np.testing.assert_allclose(depth, 8.0 * before[0], rtol=1e-4)
    np.testing.assert_allclose(confidence, before[1], atol=1e-5)
    assert np.abs(before[0] - found(network, images, T)[0]).max() > 1e-3  # it would

"""METER with the published weights says what its authors' code says.

It wants the published file beside this clone (`../shared/weights`, or METER_CHECKPOINT=FILE), the authors' code
(`../METER`, or METER=FOLDER), PyTorch and einops, and is skipped where one is missing.
"""

import os
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from scene import compose, device, on_host
from views import BESIDE, random_views, real_views

from emgs_jax.prior.pretrained.meter import SOURCE, build_network, predict
from emgs_jax.prior.pretrained.weights import load_network

pytestmark = pytest.mark.slow


CHECKPOINT = Path(os.environ.get("METER_CHECKPOINT", BESIDE / "shared/weights/meter_nyu_xxs"))
ORIGINAL = Path(os.environ.get("METER", BESIDE / "METER"))
SIZE = (192, 256)


def original(images):
    """Depth of the authors' code, whose classes for sizes that are not used here do not compile."""
    torch = pytest.importorskip("torch", reason="torch is not installed")
    pytest.importorskip("einops", reason="einops is not installed")
    if not (ORIGINAL / "architecture.py").is_file():
        pytest.skip(f"the code of METER is not at {ORIGINAL}: git clone https://github.com/lorenzopapa5/METER")
    code = (ORIGINAL / "architecture.py").read_text()
    code = code.replace("RGB_img_res[2])), dims", "RGB_img_res[2]), dims").replace("cuda:0", "cpu")
    module = ModuleType("architecture")
    sys.modules["globals"] = SimpleNamespace(RGB_img_res=(3, *SIZE))
    try:
        exec(compile(code, "architecture.py", "exec"), module.__dict__)
    finally:
        del sys.modules["globals"]
    network = module.build_METER_model("cpu", "xxs").eval()
    network.load_state_dict(torch.load(CHECKPOINT, map_location="cpu", weights_only=True))
    shown = (images - images.mean((1, 2, 3), keepdims=True)) / np.sqrt(images.var((1, 2, 3), keepdims=True) + 1e-5)
    with torch.no_grad():
        return network(torch.tensor(shown.transpose(0, 3, 1, 2)))[:, 0].numpy()


@pytest.mark.parametrize("views", [random_views, real_views])
def test_depth_is_that_of_the_authors_code(views):
    if not CHECKPOINT.is_file():
        pytest.skip(f"the published weights are not at {CHECKPOINT}")
    images, _ = views(SIZE)
    network = load_network(
        str(CHECKPOINT),
        compose("prior=multiview_stereo", "prior/dense=meter").prior.dense.sha256,
        SOURCE,
        None,
        build_network,
    )
    depths = np.stack([on_host(predict)(network, device(image)) for image in images])
    known = original(images)
    np.testing.assert_allclose(depths, known, atol=1e-4 * np.median(known))

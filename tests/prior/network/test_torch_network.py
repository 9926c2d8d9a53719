"""The torch side: loading without a network, tensors in and out, what it says when something is missing.

Tests that need torch are skipped without it; the framework itself is a stand-in here, see test_mapanything_real.py.
"""

import json
import os
import sys
from pathlib import Path
from types import ModuleType

import hydra
import numpy as np
import pytest
from network_double import Double, Sphere
from tiny_run import compose

from emgs_jax.prior.base import windows
from emgs_jax.prior.network import torch_network
from emgs_jax.prior.network.framework import MODELS, ComputeConfig, NetworkSettings, check_checkpoint
from emgs_jax.prior.network.torch_network import load_network


def settings(model="mapanything", checkpoint=None, device="cpu", amp="bf16"):
    return NetworkSettings(model, checkpoint, ComputeConfig(device, amp, True, 1))


def write_checkpoint(folder: Path, encoder: dict) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "config.json").write_text(json.dumps({"encoder_config": encoder}))
    (folder / "model.safetensors").write_bytes(b"weights")
    return folder


def clone(hub: Path) -> Path:
    """A stand-in for DINOv2's repository, with an entry that says what it was asked for."""
    folder = hub / "facebookresearch_dinov2_main"
    folder.mkdir(parents=True)
    (folder / "hubconf.py").write_text("def dinov2_vitg14(pretrained=True):\n    return ('random', pretrained)\n")
    return folder


DINOV2 = {"encoder_str": "dinov2_giant_24_layers", "torch_hub_pretrained": False}


@pytest.mark.parametrize("missing", ["torch", "mapanything.models"])
def test_without_torch_or_the_framework_the_prior_says_what_to_install(monkeypatch, tmp_path, missing):
    if missing != "torch":
        pytest.importorskip("torch")
    monkeypatch.setitem(sys.modules, missing, None)
    folder = write_checkpoint(tmp_path, {"encoder_str": "patch_embedder"})
    config = compose("prior=mapanything", f"prior.checkpoint={folder}").prior
    with pytest.raises(hydra.errors.InstantiationException) as raised:
        hydra.utils.instantiate(config)
    said = str(raised.value.__cause__)
    assert isinstance(raised.value.__cause__, ValueError) and missing in said
    for part in ('-e ".[mapanything]"', "facebookresearch/map-anything", "--no-deps", "prior=recorded"):
        assert part in said


def test_a_checkpoint_that_is_not_set_or_lacks_files_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"prior.checkpoint is not set.*map-anything-apache"):
        check_checkpoint(None, tmp_path)
    with pytest.raises(ValueError, match="no config.json and no model.safetensors"):
        check_checkpoint(tmp_path / "nowhere", tmp_path)
    folder = write_checkpoint(tmp_path / "half", DINOV2)
    (folder / "model.safetensors").unlink()
    with pytest.raises(ValueError, match="half has no model.safetensors"):
        check_checkpoint(folder, tmp_path)


@pytest.mark.parametrize("content", ["{", "[1, 2]", '{"name": "x"}', '{"encoder_config": 3}'])
def test_a_configuration_that_is_none_is_refused(tmp_path, content):
    folder = write_checkpoint(tmp_path / "foreign", DINOV2)
    (folder / "config.json").write_text(content)
    with pytest.raises(ValueError, match="config.json is no configuration of MapAnything"):
        check_checkpoint(folder, tmp_path)


def test_a_download_by_the_encoder_is_found_before_it_happens(tmp_path):
    folder = write_checkpoint(tmp_path / "published", {"encoder_str": "dinov2_giant_24_layers"})
    with pytest.raises(ValueError, match='add "torch_hub_pretrained": false to its encoder_config'):
        check_checkpoint(folder, tmp_path)
    write_checkpoint(folder, DINOV2)
    with pytest.raises(ValueError, match="clone the GitHub repository facebookresearch/dinov2"):
        check_checkpoint(folder, tmp_path / "hub")
    clone(tmp_path / "hub")
    check_checkpoint(folder, tmp_path / "hub")
    check_checkpoint(write_checkpoint(folder, {"encoder_str": "patch_embedder"}), tmp_path / "no hub")


@pytest.fixture
def torch(monkeypatch, tmp_path):
    module = pytest.importorskip("torch")
    monkeypatch.setattr(module.hub, "_hub_dir", str(tmp_path / "hub"))
    monkeypatch.setenv("HF_HUB_OFFLINE", "0")
    monkeypatch.setenv("TRANSFORMERS_OFFLINE", "0")
    return module


class Loaded:
    """What from_pretrained returns: the double, with the methods of a module."""

    def __init__(self, double):
        self._double, self.is_evaluated = double, False

    def to(self, device):
        return self

    def eval(self):
        self.is_evaluated = True
        return self

    def infer(self, views, **options):
        assert self.is_evaluated
        return self._double.infer(views, **options)

    def __call__(self, views):
        return self._double.answer(views)


@pytest.fixture
def framework(monkeypatch, torch):
    """A stand-in for the package, around a double whose arrays are tensors."""
    data = Sphere()
    model = Loaded(Double(data, convert=torch.from_numpy))
    modules = {name: ModuleType(name) for name in ("mapanything", "mapanything.models", "mapanything.utils.inference")}
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(sys.modules, "mapanything.utils", ModuleType("mapanything.utils"))

    class MapAnything:
        @staticmethod
        def from_pretrained(folder):
            # As UniCeption's encoder does; with the hub's own `load` this is a request to the network.
            encoder = torch.hub.load("facebookresearch/dinov2", "dinov2_vitg14", force_reload=False, pretrained=False)
            assert encoder == ("random", False)
            return model

    modules["mapanything.models"].MapAnything = MapAnything
    modules["mapanything.models"].init_model_from_config = lambda name, device: model
    modules["mapanything.utils.inference"].postprocess_model_outputs_for_inference = lambda raw, views, apply_mask: (
        raw if not apply_mask else None
    )
    return data, model, modules["mapanything.models"]


@pytest.fixture
def no_network(monkeypatch):
    """A machine where every request fails, and a list of them."""
    import urllib.error
    import urllib.request

    requests = []

    def refuse(request, *arguments, **options):
        requests.append(request)
        raise urllib.error.URLError("no network")

    monkeypatch.setattr(urllib.request, "urlopen", refuse)
    hub = sys.modules.get("torch.hub")
    if hub is not None:
        monkeypatch.setattr(hub, "urlopen", refuse)
    return requests


def make(data, folder, *overrides):
    config = compose("prior=mapanything", f"prior.checkpoint={folder}", "prior.resolution=[56,42]", *overrides).prior
    return hydra.utils.instantiate(config)


def test_a_checkpoint_is_loaded_and_asked_without_any_request(torch, framework, no_network, tmp_path):
    data, _, _ = framework
    clone(tmp_path / "hub")
    load = torch.hub.load
    prior = make(data, write_checkpoint(tmp_path / "weights", DINOV2))
    assert os.environ["HF_HUB_OFFLINE"] == os.environ["TRANSFORMERS_OFFLINE"] == "1"
    assert no_network == [] and torch.hub.load is load
    described = prior.provenance.settings
    assert (described["device"], described["amp"], len(described["checkpoint_sha256"])) == ("cpu", "float32", 64)
    for window in windows(len(data), 3):
        prediction = prior.predict(window, [data[i] for i in window.views], data.intrinsics)
        for index in window.dense:
            relative = np.linalg.inv(data.pose(0)) @ data.pose(index)
            got = prediction.T_anchor_view[window.views.index(index)]
            np.testing.assert_allclose(got[:3, 3], 1.05 * relative[:3, 3], atol=2e-6)
    assert prior.report()["prior/peak_gpu_mib"] == 0


def test_other_weights_are_another_provenance(framework, tmp_path):
    clone(tmp_path / "hub")
    folder = write_checkpoint(tmp_path / "weights", DINOV2)
    digest = load_network(settings(checkpoint=folder)).described["checkpoint_sha256"]
    assert load_network(settings(checkpoint=folder)).described["checkpoint_sha256"] == digest
    (folder / "model.safetensors").write_bytes(b"other")
    assert load_network(settings(checkpoint=folder)).described["checkpoint_sha256"] != digest


def test_a_network_that_takes_images_only_goes_through_the_frameworks_postprocessing(torch, framework):
    data, _, models = framework
    model = Loaded(Double(data, convert=torch.from_numpy, patch=16))
    models.init_model_from_config = lambda name, device: model
    prior = make(data, "null", "prior.model=mast3r", "prior.resolution=[64,48]")
    window = next(windows(len(data), 3))
    prediction = prior.predict(window, [data[i] for i in window.views], data.intrinsics)
    assert model.is_evaluated and prediction.mask.all()
    relative = np.linalg.inv(data.pose(0)) @ data.pose(2)
    np.testing.assert_allclose(prediction.T_anchor_view[2, :3, 3], 1.1 * relative[:3, 3], atol=2e-6)
    assert (prior.provenance.settings["scale"], prior.provenance.settings["is_calibrated"]) == ("metric", False)


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (ImportError("No module named 'dust3r'"), r"pip install -e '\.\[dust3r\]'"),
        (OSError("offline"), "not in the local caches .* download them once beforehand"),
    ],
)
def test_what_another_network_lacks_is_said(framework, error, text):
    _, _, models = framework

    def fail(name, device):
        raise error

    models.init_model_from_config = fail
    with pytest.raises(ValueError, match=text):
        load_network(settings("dust3r"))


def test_composing_the_frameworks_configuration_leaves_ours_alone(framework):
    from hydra.core.global_hydra import GlobalHydra

    _, model, models = framework

    def compose_there(name, device):
        GlobalHydra.instance().clear()
        return model

    models.init_model_from_config = compose_there
    with hydra.initialize(version_base=None, config_path=None):
        outer = GlobalHydra.instance().hydra
        load_network(settings("dust3r"))
        assert GlobalHydra.instance().hydra is outer


@pytest.mark.parametrize("model", [name for name, known in MODELS.items() if known.needs_gpu])
def test_a_network_that_needs_a_gpu_says_so(torch, model):
    with pytest.raises(ValueError, match=f"prior.model={model} cannot be built without a GPU"):
        load_network(settings(model))


def test_a_gpu_that_is_not_there_is_named(torch, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match="device=cuda:1, but torch .* finds no GPU"):
        load_network(settings(device="cuda:1"))


def test_nothing_is_downloaded_while_a_network_is_loaded(torch, no_network, tmp_path):
    with torch_network._offline(torch):
        with pytest.raises(OSError, match="clone the GitHub repository owner/name"):
            torch.hub.load("owner/name:v1", "entry")
        with pytest.raises(OSError, match="nothing is downloaded at run time"):
            torch.hub.load_state_dict_from_url("https://example.invalid/weights.pth", model_dir=str(tmp_path))
    assert no_network == []


def test_out_of_memory_names_the_window_and_what_to_lower(torch, framework, tmp_path):
    data, model, _ = framework
    clone(tmp_path / "hub")
    prior = make(data, write_checkpoint(tmp_path / "weights", DINOV2))

    def exhausted(views, **options):
        raise torch.cuda.OutOfMemoryError("tried to allocate 2 GiB")

    model.infer = exhausted
    window = next(windows(len(data), 3))
    with pytest.raises(ValueError, match="does not suffice for 3 images of 56x42") as raised:
        prior.predict(window, [data[i] for i in window.views], data.intrinsics)
    for part in ("slam.window_size", "prior.resolution", "memory_efficient", "XLA_PYTHON_CLIENT_PREALLOCATE"):
        assert part in str(raised.value)


def test_tensors_become_arrays_whatever_their_type(torch):
    assert torch_network._array(torch.ones(2, dtype=torch.bfloat16)).dtype == np.float32
    assert torch_network._array(torch.tensor([True])).dtype == np.bool_
    assert torch_network._array(["dinov2"]) == ["dinov2"]

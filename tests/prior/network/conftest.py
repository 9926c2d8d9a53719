"""A stand-in for the package mapanything, and a machine without a network."""

import sys
from types import ModuleType, SimpleNamespace

import pytest
from network_double import Double, Sphere


@pytest.fixture
def torch(monkeypatch, tmp_path):
    module = pytest.importorskip("torch")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setenv("HF_HUB_OFFLINE", "0")
    monkeypatch.setenv("TRANSFORMERS_OFFLINE", "0")
    return module


@pytest.fixture
def framework(monkeypatch, torch):
    """A stand-in for the package, around a double whose arrays are tensors."""
    data = Sphere()
    model = SimpleNamespace(infer=Double(data, convert=torch.from_numpy).infer)
    for name in ("mapanything", "mapanything.models"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))

    mixin = pytest.importorskip("huggingface_hub", reason="MapAnything is loaded by its mixin").PyTorchModelHubMixin
    pytest.importorskip("safetensors", reason="the mixin reads such files")

    class MapAnything(torch.nn.Module, mixin):
        """Loaded by the mixin itself, which is not strict unless it is told to be."""

        def __init__(self, encoder_config):
            super().__init__()
            # As UniCeption's encoder does; with the hub's own `load` this is a request to the network.
            encoder = torch.hub.load("facebookresearch/dinov2", "dinov2_vitg14", force_reload=False, pretrained=False)
            assert encoder == ("random", False)
            self.head = torch.nn.Linear(3, 2)
            self.same_head = self.head  # files have one of the two names

        def infer(self, views, **options):
            assert not self.training
            return model.infer(views, **options)

    sys.modules["mapanything.models"].MapAnything = MapAnything
    return data, model


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

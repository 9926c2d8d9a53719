"""The torch side: loading without a network, tensors in and out, what it says when something is missing.

Tests that need torch are skipped without it; the framework itself is a stand-in here, see test_mapanything_real.py.
"""

import os
import sys
from dataclasses import replace
from pathlib import Path

import hydra
import numpy as np
import pytest
from network_double import Double
from network_stand_in import DINOV2, Loaded, clone, settings, write_checkpoint, write_weights
from omegaconf.errors import InterpolationToMissingValueError
from tiny_run import compose

from emgs_jax.prior.base import windows
from emgs_jax.prior.network import loading
from emgs_jax.prior.network.framework import MODELS, USED_OUTPUTS, build_views, check_checkpoint
from emgs_jax.prior.network.resize import plan_resize
from emgs_jax.prior.network.torch_network import load_network


def make(folder, *overrides):
    config = compose("prior=mapanything", f"prior.checkpoint={folder}", "prior.resolution=[56,42]", *overrides).prior
    return hydra.utils.instantiate(config)


def made(framework, model, name):
    """The prior around a network that the framework configures."""
    framework[2].init_model_from_config = lambda name, device: model
    return make("null", f"prior.model={name}", "prior.resolution=[64,48]")


def ask(prior, data, number=0):
    window = list(windows(len(data), 3))[number]
    return prior.predict(window, [data[i] for i in window.views], data.intrinsics)


@pytest.fixture
def weights(framework, tmp_path):
    """Folder of a checkpoint that can be loaded."""
    clone(tmp_path / "hub")
    folder = write_checkpoint(tmp_path / "weights", DINOV2)
    write_weights(folder)
    return folder


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A folder that packages are imported from before all others."""
    for name in ("mapanything", "mapanything.models", "torchvision"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "mapanything").mkdir()
    yield tmp_path
    for name in ("mapanything", "mapanything.models", "torchvision"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("missing", ["torch", "mapanything.models"])
def test_without_torch_or_the_framework_the_prior_says_what_to_install(monkeypatch, tmp_path, missing):
    if missing != "torch":
        pytest.importorskip("torch")
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(hydra.errors.InstantiationException) as raised:
        make(write_checkpoint(tmp_path, {"encoder_str": "patch_embedder"}))
    said = str(raised.value.__cause__)
    assert isinstance(raised.value.__cause__, ValueError) and missing in said
    for part in ('-e ".[mapanything]"', "facebookresearch/map-anything", "--no-deps", "prior=recorded"):
        assert part in said


def test_a_package_of_another_torch_is_named_instead_of_what_it_broke(torch, site):
    """torchvision ends the import of the framework with a RuntimeError."""
    broken = "raise RuntimeError('operator torchvision::nms does not exist')\n"
    (site / "mapanything" / "models.py").write_text(broken)
    (site / "torchvision.py").write_text(broken)
    with pytest.raises(ValueError, match="cannot import mapanything.models: torchvision .*nms does not exist"):
        loading.import_framework("mapanything.models")


def test_a_checkpoint_that_cannot_be_loaded_without_a_network_is_named_with_the_remedy(tmp_path):
    with pytest.raises(ValueError, match=r"prior.checkpoint is not set.*map-anything-apache"):
        check_checkpoint(None, tmp_path)
    with pytest.raises(ValueError, match="no config.json and no model.safetensors"):
        check_checkpoint(tmp_path / "nowhere", tmp_path)
    folder = write_checkpoint(tmp_path / "half", {"encoder_str": "dinov2_giant_24_layers"})
    with pytest.raises(ValueError, match='add "torch_hub_pretrained": false to its encoder_config'):
        check_checkpoint(folder, tmp_path)
    write_checkpoint(folder, DINOV2)
    with pytest.raises(ValueError, match="clone the GitHub repository facebookresearch/dinov2"):
        check_checkpoint(folder, tmp_path / "hub")
    clone(tmp_path / "hub")
    check_checkpoint(folder, tmp_path / "hub")
    check_checkpoint(write_checkpoint(folder, {"encoder_str": "patch_embedder"}), tmp_path / "no hub")
    for content in ("{", "[1, 2]", '{"name": "x"}', '{"encoder_config": 3}'):
        (folder / "config.json").write_text(content)
        with pytest.raises(ValueError, match="config.json is no configuration of MapAnything"):
            check_checkpoint(folder, tmp_path)
    (folder / "model.safetensors").unlink()
    with pytest.raises(ValueError, match="half has no model.safetensors"):
        check_checkpoint(folder, tmp_path)


def test_a_checkpoint_is_loaded_and_asked_without_any_request(torch, framework, no_network, weights):
    data, _, _ = framework
    load = torch.hub.load
    prior = make(weights)
    assert os.environ["HF_HUB_OFFLINE"] == os.environ["TRANSFORMERS_OFFLINE"] == "1"
    assert no_network == [] and torch.hub.load is load
    described = prior.provenance.settings
    assert (described["device"], described["amp"], len(described["checkpoint_sha256"])) == ("cpu", "float32", 64)
    for number, window in enumerate(windows(len(data), 3)):
        prediction = ask(prior, data, number)
        for index in window.dense:
            relative = np.linalg.inv(data.pose(0)) @ data.pose(index)
            got = prediction.T_anchor_view[window.views.index(index)]
            np.testing.assert_allclose(got[:3, 3], 1.05 * relative[:3, 3], atol=2e-6)
    assert prior.report()["prior/peak_gpu_mib"] == 0
    digests = [make(weights).provenance.settings["checkpoint_sha256"]]
    write_weights(weights)
    digests.append(make(weights).provenance.settings["checkpoint_sha256"])
    assert digests[0] == described["checkpoint_sha256"] != digests[1], "other weights are another provenance"


GEOMETRY = ("camera_intrinsics", "depthmap", "camera_pose", "true_shape")


@pytest.mark.parametrize(
    ("name", "reads"), [("mast3r", ("label", "instance")), ("must3r", ("label", "instance")), ("pow3r_ba", GEOMETRY)]
)
def test_wrappers_find_in_every_view_what_they_read(torch, framework, monkeypatch, name, reads):
    """Some could not work: a KeyError in the first window. MASt3R takes views of one name for one view."""
    data = framework[0]
    model = Loaded(Double(data, convert=torch.from_numpy, patch=16), reads)
    monkeypatch.setitem(MODELS, name, replace(MODELS[name], needs_gpu=False))
    prior = made(framework, model, name)
    prediction = ask(prior, data, 1)
    if "instance" in reads:
        assert len({view["instance"][0] for view in model.given}) == len(prediction.window.views)
    else:
        assert [tuple(view["depthmap"].shape) for view in model.given] == [(1, 48, 64, 1)] * len(
            prediction.window.views
        )
        assert torch.equal(model.given[0]["true_shape"], torch.tensor([[48, 64]]))
    assert model.is_evaluated and prediction.mask.all() and prior.provenance.settings["is_calibrated"] is False
    if name == "mast3r":  # the others have a unit of their own
        relative = np.linalg.inv(data.pose(0)) @ data.pose(2)
        np.testing.assert_allclose(prediction.T_anchor_view[2, :3, 3], 1.1 * relative[:3, 3], atol=2e-6)


def test_every_window_has_a_cache_of_its_own(torch, framework):
    """MASt3R keeps under the names of the views what it made of them together with the other views."""
    folders = []

    class Keeps(Loaded):
        cache_dir = "somewhere"

        def __call__(self, views):
            folders.append(Path(self.cache_dir))
            assert folders[-1].is_dir() and not any(folders[-1].iterdir())
            (folders[-1] / "kept").touch()
            return super().__call__(views)

    data = framework[0]
    prior = made(framework, Keeps(Double(data, convert=torch.from_numpy, patch=16), ("label", "instance")), "mast3r")
    for number in range(2):
        ask(prior, data, number)
    assert len(set(folders)) == len(folders) > 1 and not any(folder.exists() for folder in folders)


def test_networks_may_optimise_and_draw_and_give_the_same_answer_twice(torch, framework):
    """DUSt3R's wrapper aligns its points by gradients, which inference_mode forbids, from a random start."""

    class Optimises(Loaded):
        def __call__(self, views):
            with torch.enable_grad():
                start = torch.rand(1, requires_grad=True)
                (start - views[0]["img"].mean()).square().sum().backward()
            outputs = super().__call__(views)
            outputs[0]["pts3d_cam"] = outputs[0]["pts3d_cam"] + start + start.grad
            return outputs

    data = framework[0]
    prior = made(framework, Optimises(Double(data, convert=torch.from_numpy, patch=16)), "dust3r")
    a = ask(prior, data)
    torch.rand(1)  # of somebody else
    b = ask(prior, data)
    assert a.points.tobytes() == b.points.tobytes() and a.mask.any()


@pytest.mark.parametrize(("name", "expected"), [("dust3r", "float32"), ("must3r", "fp16"), ("vggt", "fp16")])
def test_the_precision_of_a_wrapper_is_that_of_the_provenance(torch, framework, monkeypatch, name, expected):
    """Wrappers have a precision of their own, and the provenance said what the config asked for."""
    _, model, models = framework
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    network = load_network(settings(name, device="cuda", amp="fp16"))
    assert network.described == {"device": "cuda", "amp": expected}
    own = {"dust3r": ("bf16", None), "must3r": ("fp16", None), "vggt": ("bf16", torch.float16)}
    assert (model.amp, model.dtype) == own[name]
    models.init_model_from_config = lambda name, device: torch.nn.Linear(1, 1)
    with pytest.raises(ValueError, match=r"prior.model=pi3 keeps no \.dtype: this version of mapanything"):
        load_network(settings("pi3", device="cuda"))


def test_a_cpu_that_nobody_asked_for_is_mentioned_and_a_gpu_that_is_not_there_is_an_error(
    framework, capsys, monkeypatch
):
    load_network(settings("dust3r", device="cpu"))
    assert "finds no GPU" not in capsys.readouterr().err
    monkeypatch.setattr(sys.modules["torch"].cuda, "is_available", lambda: False)
    load_network(settings("dust3r", device=None))
    assert "finds no GPU, so prior.model=dust3r runs on the CPU, which is slow" in capsys.readouterr().err
    with pytest.raises(ValueError, match="device=cuda:1, but torch .* finds no GPU"):
        load_network(settings(device="cuda:1"))
    for model in (name for name, known in MODELS.items() if known.needs_gpu):
        with pytest.raises(ValueError, match=f"prior.model={model} cannot be built without a GPU"):
            load_network(settings(model))


def test_only_what_is_used_is_copied_and_numbers_of_16_bits_become_float32(torch, framework):
    data, _, models = framework

    class Counted:
        """A tensor that counts what is taken from it."""

        copied = []

        def __init__(self, value):
            self.tensor = torch.from_numpy(value)

        def detach(self):
            self.copied.append(self)
            return self.tensor.bfloat16() if self.tensor.is_floating_point() else self.tensor

    models.init_model_from_config = lambda name, device: Loaded(Double(data, convert=Counted))
    images = [np.full((42, 56, 3), i, np.uint8) for i in range(2)]
    views = build_views(images, data.intrinsics, plan_resize((40, 30), (56, 42)), MODELS["vggt"], None)
    outputs = load_network(settings("dust3r")).infer(views)
    assert set(outputs[0]) == set(USED_OUTPUTS) and len(Counted.copied) == 2 * len(USED_OUTPUTS)
    kinds = {key: value.dtype for key, value in outputs[0].items()}
    assert kinds == dict.fromkeys(USED_OUTPUTS, np.float32) | {"non_ambiguous_mask": np.bool_}


def test_rays_that_no_camera_has_are_no_answer_and_no_end(torch, framework):
    """Upstream fits a camera by least squares, and said that a matrix is singular."""
    solve, data = torch.linalg.inv, framework[0]

    class Degenerate(Loaded):
        def __call__(self, views):
            return solve(torch.zeros(2, 2))

    prediction = ask(made(framework, Degenerate(Double(data)), "dust3r"), data)
    assert not prediction.mask.any() and not prediction.points.any() and (prediction.confidence == 1).all()
    np.testing.assert_array_equal(prediction.T_anchor_view[0], np.eye(4))
    assert np.isnan(prediction.T_anchor_view[1:]).all()
    assert prediction.points.shape == (len(prediction.window.dense), 30, 40, 3)


class NotCached(FileNotFoundError, ValueError):
    """As huggingface_hub's error where it is offline."""


@pytest.mark.parametrize(
    ("model", "error", "text"),
    [
        ("metric_dust3r", ImportError("No module named 'dust3r'"), r"pip install -e '\.\[dust3r\]'"),
        ("pi3x", ImportError("No module named 'one'"), r"pip install -e '\.\[pi3\]'"),
        ("pow3r_ba", ImportError("No module named 'one'"), r"pip install -e '\.\[pow3r\]'"),
        ("da3", ImportError("No module named 'one'"), r"pip install -e '\.\[depth-anything-3\]'"),
        ("metric_dust3r", NotCached("cannot find it"), "is not in the local caches .* download it once beforehand"),
        ("metric_dust3r", OSError("offline"), "is not in the local caches .* download it once beforehand"),
        ("metric_dust3r", InterpolationToMissingValueError("???"), "set in configs/machine/default.yaml in the clone"),
        (
            "metric_dust3r",
            FileNotFoundError(2, "No such file or directory", "/weights/DUSt3R.pth"),
            "metric_dust3r needs the file /weights/DUSt3R.pth .*MASt3R, metric.*root_pretrained_checkpoints_dir",
        ),
        ("metric_dust3r", RuntimeError("reader failed\nline 2"), r"cannot be made \(reader failed\): .*damaged"),
    ],
)
def test_what_another_network_lacks_is_said(framework, monkeypatch, model, error, text):
    def fail(name, device):
        raise error

    monkeypatch.setattr(sys.modules["torch"].cuda, "is_available", lambda: True)
    framework[2].init_model_from_config = fail
    with pytest.raises(ValueError, match=text):
        load_network(settings(model, device="cuda"))


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


def test_nothing_is_downloaded_while_a_network_is_loaded(torch, no_network, tmp_path):
    with loading.offline(torch):
        with pytest.raises(OSError, match="clone the GitHub repository owner/name"):
            torch.hub.load("owner/name:v1", "entry")
        with pytest.raises(OSError, match="nothing is downloaded at run time"):
            torch.hub.load_state_dict_from_url("https://example.invalid/weights.pth", model_dir=str(tmp_path))
    assert no_network == []


def test_out_of_memory_names_the_window_and_what_to_lower(torch, framework):
    data = framework[0]

    class Exhausted(Loaded):
        def __call__(self, views):
            raise torch.cuda.OutOfMemoryError("tried to allocate 2 GiB")

    with pytest.raises(ValueError, match="does not suffice for 3 images of 64x48") as raised:
        ask(made(framework, Exhausted(Double(data)), "dust3r"), data)
    for part in ("slam.window_size", "prior.resolution", "memory_efficient", "XLA_PYTHON_CLIENT_PREALLOCATE"):
        assert part in str(raised.value)

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
from emgs_jax.prior.network import loading, torch_network
from emgs_jax.prior.network.framework import MODELS, USED_OUTPUTS, build_views, check_checkpoint
from emgs_jax.prior.network.resize import plan_resize
from emgs_jax.prior.network.torch_network import load_network


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


def test_a_package_of_another_torch_is_named_instead_of_what_it_broke(torch, monkeypatch, tmp_path):
    """torchvision ends the import of the framework with a RuntimeError."""

    def fail(name):
        raise RuntimeError("operator torchvision::nms does not exist")

    monkeypatch.setattr(loading.importlib, "import_module", fail)
    monkeypatch.setattr(loading, "companion_problem", lambda: "torchvision 1 does not fit torch 2 (…): reinstall")
    with pytest.raises(ValueError, match="cannot import mapanything.models: torchvision 1 does not fit torch 2"):
        loading.import_framework("mapanything.models")
    monkeypatch.setattr(loading, "companion_problem", lambda: None)
    with pytest.raises(RuntimeError, match="nms"):
        loading.import_framework("mapanything.models")


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


def make(data, folder, *overrides):
    config = compose("prior=mapanything", f"prior.checkpoint={folder}", "prior.resolution=[56,42]", *overrides).prior
    return hydra.utils.instantiate(config)


def test_a_checkpoint_is_loaded_and_asked_without_any_request(torch, framework, no_network, tmp_path):
    data, _, _ = framework
    clone(tmp_path / "hub")
    load = torch.hub.load
    folder = write_checkpoint(tmp_path / "weights", DINOV2)
    write_weights(folder)
    prior = make(data, folder)
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
    write_weights(folder)
    digest = load_network(settings(checkpoint=folder)).described["checkpoint_sha256"]
    assert load_network(settings(checkpoint=folder)).described["checkpoint_sha256"] == digest
    write_weights(folder)
    assert load_network(settings(checkpoint=folder)).described["checkpoint_sha256"] != digest


def test_a_network_that_takes_images_only_goes_through_the_frameworks_postprocessing(torch, framework):
    data, _, models = framework
    model = Loaded(Double(data, convert=torch.from_numpy, patch=16), ("label", "instance"))
    models.init_model_from_config = lambda name, device: model
    prior = make(data, "null", "prior.model=mast3r", "prior.resolution=[64,48]")
    window = next(windows(len(data), 3))
    prediction = prior.predict(window, [data[i] for i in window.views], data.intrinsics)
    assert model.is_evaluated and prediction.mask.all()
    relative = np.linalg.inv(data.pose(0)) @ data.pose(2)
    np.testing.assert_allclose(prediction.T_anchor_view[2, :3, 3], 1.1 * relative[:3, 3], atol=2e-6)
    assert (prior.provenance.settings["scale"], prior.provenance.settings["is_calibrated"]) == ("metric", False)


GEOMETRY = ("camera_intrinsics", "depthmap", "camera_pose", "true_shape")


@pytest.mark.parametrize(
    ("name", "reads"), [("mast3r", ("label", "instance")), ("must3r", ("label", "instance")), ("pow3r_ba", GEOMETRY)]
)
def test_wrappers_find_in_every_view_what_they_read(torch, framework, monkeypatch, name, reads):
    """Some could not work: a KeyError in the first window. MASt3R takes views of one name for one view."""
    data, _, models = framework
    model = Loaded(Double(data, convert=torch.from_numpy, patch=16), reads)
    models.init_model_from_config = lambda name, device: model
    monkeypatch.setitem(MODELS, name, replace(MODELS[name], needs_gpu=False))
    prior = make(data, "null", f"prior.model={name}", "prior.resolution=[64,48]")
    window = list(windows(len(data), 3))[1]
    prior.predict(window, [data[i] for i in window.views], data.intrinsics)
    if "instance" in reads:
        assert len({view["instance"][0] for view in model.given}) == len(window.views)
    else:
        assert [tuple(view["depthmap"].shape) for view in model.given] == [(1, 48, 64, 1)] * len(window.views)
        assert torch.equal(model.given[0]["true_shape"], torch.tensor([[48, 64]]))


def test_every_window_has_a_cache_of_its_own(torch, framework, tmp_path):
    """MASt3R keeps under the names of the views what it made of them together with the other views."""
    data, _, models = framework
    folders = []

    class Keeps(Loaded):
        cache_dir = "somewhere"

        def __call__(self, views):
            folders.append(Path(self.cache_dir))
            assert folders[-1].is_dir() and not any(folders[-1].iterdir())
            (folders[-1] / "kept").touch()
            return super().__call__(views)

    model = Keeps(Double(data, convert=torch.from_numpy, patch=16), ("label", "instance"))
    models.init_model_from_config = lambda name, device: model
    prior = make(data, "null", "prior.model=mast3r", "prior.resolution=[64,48]")
    for window in windows(len(data), 3):
        prior.predict(window, [data[i] for i in window.views], data.intrinsics)
    assert len(set(folders)) == len(folders) > 1 and not any(folder.exists() for folder in folders)


def test_networks_may_optimise_and_draw_and_give_the_same_answer_twice(torch, framework):
    """DUSt3R's wrapper aligns its points by gradients, which inference_mode forbids, from a random start."""
    data, _, models = framework

    class Optimises(Loaded):
        def __call__(self, views):
            with torch.enable_grad():
                start = torch.rand(1, requires_grad=True)
                (start - views[0]["img"].mean()).square().sum().backward()
            outputs = super().__call__(views)
            outputs[0]["pts3d_cam"] = outputs[0]["pts3d_cam"] + start + start.grad
            return outputs

    model = Optimises(Double(data, convert=torch.from_numpy, patch=16))
    models.init_model_from_config = lambda name, device: model
    prior = make(data, "null", "prior.model=dust3r", "prior.resolution=[64,48]")
    window = next(windows(len(data), 3))
    a = prior.predict(window, [data[i] for i in window.views], data.intrinsics)
    torch.rand(1)  # of somebody else
    b = prior.predict(window, [data[i] for i in window.views], data.intrinsics)
    assert a.points.tobytes() == b.points.tobytes() and a.mask.any()


@pytest.mark.parametrize(("name", "expected"), [("dust3r", "float32"), ("must3r", "fp16"), ("vggt", "fp16")])
def test_the_precision_of_a_wrapper_is_that_of_the_provenance(torch, framework, monkeypatch, name, expected):
    """Wrappers have a precision of their own, and the provenance said what the config asked for."""
    _, model, _ = framework
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    network = load_network(settings(name, device="cuda", amp="fp16"))
    assert network.described == {"device": "cuda", "amp": expected}
    assert (model.amp, model.dtype) == {
        "dust3r": ("bf16", None), "must3r": ("fp16", None), "vggt": ("bf16", torch.float16)
    }[name]  # fmt: skip


def test_a_wrapper_that_keeps_its_precision_elsewhere_is_refused(torch, framework, monkeypatch):
    models = framework[2]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    models.init_model_from_config = lambda name, device: torch.nn.Linear(1, 1)
    with pytest.raises(ValueError, match=r"prior.model=pi3 keeps no \.dtype: this version of mapanything"):
        load_network(settings("pi3", device="cuda"))


def test_a_cpu_that_nobody_asked_for_is_mentioned(torch, framework, capsys):
    load_network(settings("dust3r", device="cpu"))
    assert "finds no GPU" not in capsys.readouterr().err
    load_network(settings("dust3r", device=None))
    assert "finds no GPU, so prior.model=dust3r runs on the CPU, which is slow" in capsys.readouterr().err


def test_only_what_is_used_is_copied_from_the_device(torch, framework):
    data, model, _ = framework
    network = load_network(settings("vggt" if torch.cuda.is_available() else "dust3r", device=None))
    copied = []
    model._double._convert = lambda value: Counted(torch.from_numpy(value), copied)
    model._double._patch = 14
    images = [np.full((42, 56, 3), i, np.uint8) for i in range(2)]
    views = build_views(images, data.intrinsics, plan_resize((40, 30), (56, 42)), MODELS["vggt"], None)
    outputs = network.infer(views)
    assert set(outputs[0]) == set(USED_OUTPUTS) and len(copied) == 2 * len(USED_OUTPUTS)


class Counted:
    """A tensor that counts what is taken from it."""

    def __init__(self, tensor, copied):
        self._tensor, self._copied = tensor, copied

    def detach(self):
        self._copied.append(self)
        return self._tensor


def test_rays_that_no_camera_has_are_no_answer_and_no_end(torch, framework):
    """Upstream fits a camera by least squares, and said that a matrix is singular."""
    data, model, models = framework
    solve = torch.linalg.inv

    class Degenerate(Loaded):
        def __call__(self, views):
            return solve(torch.zeros(2, 2))

    model = Degenerate(Double(data))
    models.init_model_from_config = lambda name, device: model
    prior = make(data, "null", "prior.model=dust3r", "prior.resolution=[64,48]")
    window = next(windows(len(data), 3))
    prediction = prior.predict(window, [data[i] for i in window.views], data.intrinsics)
    assert not prediction.mask.any() and not prediction.points.any() and (prediction.confidence == 1).all()
    np.testing.assert_array_equal(prediction.T_anchor_view[0], np.eye(4))
    assert np.isnan(prediction.T_anchor_view[1:]).all() and prediction.points.shape == (len(window.dense), 30, 40, 3)


@pytest.mark.parametrize(
    ("model", "extra"),
    [("metric_dust3r", "dust3r"), ("pi3x", "pi3"), ("pow3r_ba", "pow3r"), ("da3", "depth-anything-3")],
)
def test_the_extra_that_is_named_is_the_frameworks(framework, monkeypatch, model, extra):
    monkeypatch.setattr(loading, "companion_problem", lambda: None)
    monkeypatch.setattr(sys.modules["torch"].cuda, "is_available", lambda: True)

    def fail(name, device):
        raise ImportError("No module named 'one'")

    framework[2].init_model_from_config = fail
    with pytest.raises(ValueError, match=rf"pip install -e '\.\[{extra}\]'"):
        load_network(settings(model, device="cuda"))


class NotCached(FileNotFoundError, ValueError):
    """As huggingface_hub's error where it is offline."""


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (ImportError("No module named 'dust3r'"), r"pip install -e '\.\[dust3r\]'"),
        (NotCached("cannot find it on disk"), "is not in the local caches .* download it once beforehand"),
        (InterpolationToMissingValueError("???"), "is to be set in configs/machine/default.yaml in the clone"),
        (OSError("offline"), "is not in the local caches .* download it once beforehand"),
        (
            FileNotFoundError(2, "No such file or directory", "/weights/DUSt3R.pth"),
            "metric_dust3r needs the file /weights/DUSt3R.pth .*MASt3R, metric.*root_pretrained_checkpoints_dir",
        ),
        (
            RuntimeError("PytorchStreamReader failed\nline 2"),
            r"cannot be made \(PytorchStreamReader failed\): .*damaged",
        ),
    ],
)
def test_what_another_network_lacks_is_said(framework, monkeypatch, error, text):
    _, _, models = framework
    monkeypatch.setattr(loading, "companion_problem", lambda: None)

    def fail(name, device):
        raise error

    models.init_model_from_config = fail
    with pytest.raises(ValueError, match=text):
        load_network(settings("metric_dust3r"))


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
    with loading.offline(torch):
        with pytest.raises(OSError, match="clone the GitHub repository owner/name"):
            torch.hub.load("owner/name:v1", "entry")
        with pytest.raises(OSError, match="nothing is downloaded at run time"):
            torch.hub.load_state_dict_from_url("https://example.invalid/weights.pth", model_dir=str(tmp_path))
    assert no_network == []


def test_out_of_memory_names_the_window_and_what_to_lower(torch, framework, tmp_path):
    data, model, _ = framework
    clone(tmp_path / "hub")
    folder = write_checkpoint(tmp_path / "weights", DINOV2)
    write_weights(folder)
    prior = make(data, folder)

    def exhausted(views, **options):
        raise torch.cuda.OutOfMemoryError("tried to allocate 2 GiB")

    model._double.infer = exhausted
    window = next(windows(len(data), 3))
    with pytest.raises(ValueError, match="does not suffice for 3 images of 56x42") as raised:
        prior.predict(window, [data[i] for i in window.views], data.intrinsics)
    for part in ("slam.window_size", "prior.resolution", "memory_efficient", "XLA_PYTHON_CLIENT_PREALLOCATE"):
        assert part in str(raised.value)


def test_tensors_become_arrays_whatever_their_type(torch):
    assert torch_network._array(torch.ones(2, dtype=torch.bfloat16)).dtype == np.float32
    assert torch_network._array(torch.tensor([True])).dtype == np.bool_
    assert torch_network._array(["dinov2"]) == ["dinov2"]

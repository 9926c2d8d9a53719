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
from network_stand_in import DINOV2, WEIGHTS, Loaded, clone, load, write_checkpoint, write_weights
from tiny_run import compose

from emgs_jax.prior.base import windows
from emgs_jax.prior.network import torch_network
from emgs_jax.prior.network.framework import MODELS, USED_OUTPUTS, build_views, check_checkpoint
from emgs_jax.prior.network.resize import plan_resize


def make(folder, *overrides):
    config = compose("prior=mapanything", f"prior.checkpoint={folder}", "prior.resolution=[56,42]", *overrides).prior
    return hydra.utils.instantiate(config)


def made(framework, name, call=lambda views, answer: answer(views), reads=()):
    """The prior around a network that the framework configures, and the network; `call` makes its answer."""

    class Network(Loaded):
        def __call__(self, views):
            return call(views, super().__call__)

    model = Network(Double(framework[0], convert=sys.modules["torch"].from_numpy, patch=16), reads)
    framework[2].init_model_from_config = lambda name, device: model
    return make("null", f"prior.model={name}", "prior.resolution=[64,48]"), model


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
        torch_network.import_framework("mapanything.models")


def test_a_checkpoint_is_loaded_and_asked_without_any_request(torch, framework, no_network, weights):
    data, load = framework[0], torch.hub.load
    check_checkpoint(write_checkpoint(weights.parent / "other", {"encoder_str": "patch_embedder"}), Path("no hub"))
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
    monkeypatch.setitem(MODELS, name, replace(MODELS[name], needs_gpu=False))
    prior, model = made(framework, name, reads=reads)
    prediction = ask(prior, data, 1)
    if "instance" in reads:
        assert len({view["instance"][0] for view in model.given}) == len(prediction.window.views)
    else:
        assert {tuple(view["depthmap"].shape) for view in model.given} == {(1, 48, 64, 1)}
        assert torch.equal(model.given[0]["true_shape"], torch.tensor([[48, 64]]))
    assert model.is_evaluated and prediction.mask.all() and prior.provenance.settings["is_calibrated"] is False
    if name == "mast3r":  # the others have a unit of their own
        relative = np.linalg.inv(data.pose(0)) @ data.pose(2)
        np.testing.assert_allclose(prediction.T_anchor_view[2, :3, 3], 1.1 * relative[:3, 3], atol=2e-6)


def test_every_window_has_a_cache_of_its_own(torch, framework):
    """MASt3R keeps under the names of the views what it made of them together with the other views."""
    folders = []

    def keep(views, answer):
        folders.append(Path(model.cache_dir))
        assert folders[-1].is_dir() and not any(folders[-1].iterdir())
        (folders[-1] / "kept").touch()
        return answer(views)

    prior, model = made(framework, "mast3r", keep, ("label", "instance"))
    model.cache_dir = "somewhere"
    for number in range(2):
        ask(prior, framework[0], number)
    assert len(set(folders)) == len(folders) > 1 and not any(folder.exists() for folder in folders)


def test_networks_may_optimise_and_draw_and_give_the_same_answer_twice(torch, framework):
    """DUSt3R's wrapper aligns its points by gradients, which inference_mode forbids, from a random start."""

    def optimise(views, answer):
        with torch.enable_grad():
            start = torch.rand(1, requires_grad=True)
            (start - views[0]["img"].mean()).square().sum().backward()
        outputs = answer(views)
        outputs[0]["pts3d_cam"] = outputs[0]["pts3d_cam"] + start + start.grad
        return outputs

    prior, _ = made(framework, "dust3r", optimise)
    a = ask(prior, framework[0])
    torch.rand(1)  # of somebody else
    b = ask(prior, framework[0])
    assert a.points.tobytes() == b.points.tobytes() and a.mask.any()


@pytest.mark.parametrize(("name", "expected"), [("dust3r", "float32"), ("must3r", "fp16"), ("vggt", "fp16")])
def test_the_precision_of_a_wrapper_is_that_of_the_provenance(torch, framework, monkeypatch, name, expected):
    """Wrappers have a precision of their own, and the provenance said what the config asked for."""
    _, model, models = framework
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    network = load(name, device="cuda", amp="fp16")
    assert network.described == {"device": "cuda", "amp": expected}
    own = {"dust3r": ("bf16", None), "must3r": ("fp16", None), "vggt": ("bf16", torch.float16)}
    assert (model.amp, model.dtype) == own[name]
    models.init_model_from_config = lambda name, device: torch.nn.Linear(1, 1)
    with pytest.raises(ValueError, match=r"prior.model=pi3 keeps no \.dtype: this version of mapanything"):
        load("pi3", device="cuda")


def test_a_cpu_that_nobody_asked_for_is_mentioned_and_a_gpu_that_is_not_there_is_an_error(
    framework, capsys, monkeypatch
):
    load("dust3r", device="cpu")
    assert "finds no GPU" not in capsys.readouterr().err
    monkeypatch.setattr(sys.modules["torch"].cuda, "is_available", lambda: False)
    load("dust3r", device=None)
    assert "finds no GPU, so prior.model=dust3r runs on the CPU, which is slow" in capsys.readouterr().err
    with pytest.raises(ValueError, match="device=cuda:1, but torch .* finds no GPU"):
        load(device="cuda:1")
    for model in (name for name, known in MODELS.items() if known.needs_gpu):
        with pytest.raises(ValueError, match=f"prior.model={model} cannot be built without a GPU"):
            load(model)


def test_only_what_is_used_is_copied_and_numbers_of_16_bits_become_float32(torch, framework):
    def halved(value):
        tensor = torch.from_numpy(value)
        return tensor.bfloat16() if tensor.is_floating_point() else tensor

    framework[2].init_model_from_config = lambda name, device: Loaded(Double(framework[0], convert=halved))
    images = [np.full((42, 56, 3), i, np.uint8) for i in range(2)]
    views = build_views(images, framework[0].intrinsics, plan_resize((40, 30), (56, 42)), MODELS["vggt"], None)
    (output, _) = load("dust3r").infer(views)
    kinds = {key: value.dtype for key, value in output.items()}
    assert kinds == dict.fromkeys(USED_OUTPUTS, np.float32) | {"non_ambiguous_mask": np.bool_}


def test_rays_that_no_camera_has_are_no_answer_and_no_end(torch, framework):
    """Upstream fits a camera by least squares, and said that a matrix is singular."""
    solve = torch.linalg.inv
    prediction = ask(made(framework, "dust3r", lambda *_: solve(torch.zeros(2, 2)))[0], framework[0])
    assert not prediction.mask.any() and not prediction.points.any() and (prediction.confidence == 1).all()
    np.testing.assert_array_equal(prediction.T_anchor_view[0], np.eye(4))
    assert np.isnan(prediction.T_anchor_view[1:]).all()
    assert prediction.points.shape == (len(prediction.window.dense), 30, 40, 3)


@pytest.mark.parametrize(
    ("model", "error", "text"),
    [
        ("metric_dust3r", ImportError("No module named 'dust3r'"), r"pip install -e '\.\[dust3r\]'"),
        ("da3", OSError("offline"), r"cannot be made \(offline\)\. Nothing is downloaded .*DA3-GIANT.*local caches"),
        ("pi3x", RuntimeError("reader failed\nline 2"), r"made \(reader failed\)\..*root_pretrained_checkpoints_dir"),
    ],
)
def test_what_another_network_lacks_is_said(framework, monkeypatch, model, error, text):
    def fail(name, device):
        raise error

    monkeypatch.setattr(sys.modules["torch"].cuda, "is_available", lambda: True)
    framework[2].init_model_from_config = fail
    with pytest.raises(ValueError, match=text):
        load(model, device="cuda")


def test_composing_the_frameworks_configuration_leaves_ours_alone(framework):
    from hydra.core.global_hydra import GlobalHydra

    _, model, models = framework

    def compose_there(name, device):
        GlobalHydra.instance().clear()
        return model

    models.init_model_from_config = compose_there
    with hydra.initialize(version_base=None, config_path=None):
        outer = GlobalHydra.instance().hydra
        load("dust3r")
        assert GlobalHydra.instance().hydra is outer


def test_nothing_is_downloaded_while_a_network_is_loaded(torch, no_network, tmp_path):
    with torch_network.offline(torch):
        with pytest.raises(OSError, match="clone the GitHub repository owner/name"):
            torch.hub.load("owner/name:v1", "entry")
        with pytest.raises(OSError, match="nothing is downloaded at run time"):
            torch.hub.load_state_dict_from_url("https://example.invalid/weights.pth", model_dir=str(tmp_path))
    assert no_network == []


def test_out_of_memory_names_the_window_and_what_to_lower(torch, framework):
    def exhaust(*_):
        raise torch.cuda.OutOfMemoryError("tried to allocate 2 GiB")

    with pytest.raises(ValueError, match="does not suffice for 3 images of 64x48") as raised:
        ask(made(framework, "dust3r", exhaust)[0], framework[0])
    for part in ("slam.window_size", "prior.resolution", "memory_efficient", "XLA_PYTHON_CLIENT_PREALLOCATE"):
        assert part in str(raised.value)


@pytest.mark.parametrize(
    ("shapes", "text"),
    [
        ({"head__weight": (2, 3)}, r"Missing key.* \"head.bias\""),
        (
            {"body__weight": (2, 3), "head__bias": (2,)},
            r"Missing key.* \"head.weight\".*Unexpected key.* \"body.weight\"",
        ),
        (WEIGHTS | {"more": (1,)}, r"Unexpected key.* \"more\""),
        ({"head__weight": (2, 4), "head__bias": (2,)}, "size mismatch for head.weight"),
        (b"", "model.safetensors is damaged or no MapAnything's"),  # upstream says "header too large"
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "Error while deserializing header"),
    ],
)
def test_weights_that_leave_a_parameter_random_or_are_none_are_refused_by_name(framework, tmp_path, shapes, text):
    """They were accepted: two runs predicted differently under one checksum. One of two names of a tensor is enough."""
    clone(tmp_path / "hub")
    folder = write_checkpoint(tmp_path / "weights", DINOV2)
    write_weights(folder)
    load(checkpoint=folder)
    write_weights(folder, **shapes) if isinstance(shapes, dict) else (folder / "model.safetensors").write_bytes(shapes)
    with pytest.raises(ValueError, match=rf"{text}.*: repeat hf download"):
        load(checkpoint=folder)


def test_a_wrapper_may_leave_weights_aside_but_must_not_lack_any_and_strictness_ends_with_the_loading(framework, torch):
    """DUSt3R's wrapper loads MASt3R's file, which has more; both load without strictness."""
    _, model, models = framework
    own = {"weight": torch.zeros(1, 2), "bias": torch.zeros(1)}

    def make(state):
        def init(name, device):
            torch.nn.Linear(2, 1).load_state_dict(state, strict=False)
            return model

        return init

    before = torch.nn.Module.load_state_dict
    models.init_model_from_config = make(own | {"head_local": torch.zeros(3)})
    load("metric_dust3r")
    models.init_model_from_config = make({"weight": torch.zeros(1, 2)})
    with pytest.raises(ValueError, match=r"Linear lacks 1 of its weights, bias, .*MASt3R, metric"):
        load("metric_dust3r")
    with pytest.raises(RuntimeError), torch_network.whole_weights(torch):
        assert torch.nn.Module.load_state_dict is not before
        raise RuntimeError
    assert torch.nn.Module.load_state_dict is before

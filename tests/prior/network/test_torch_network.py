"""The torch side: loading without a network, tensors in and out, what it says when something is missing.

Tests that need torch are skipped without it; the framework itself is a stand-in here, see test_mapanything_real.py.
"""

import os
import sys
from pathlib import Path

import hydra
import numpy as np
import pytest
from network_double import Double
from network_stand_in import DINOV2, WEIGHTS, clone, load, write_checkpoint, write_weights
from tiny_run import compose

from emgs_jax.prior.base import windows
from emgs_jax.prior.network import torch_network
from emgs_jax.prior.network.framework import USED_OUTPUTS, build_views, check_checkpoint
from emgs_jax.prior.network.resize import plan_resize


def make(folder, *overrides):
    config = compose("prior=mapanything", f"prior.checkpoint={folder}", "prior.resolution=[56,42]", *overrides).prior
    return hydra.utils.instantiate(config)


def ask(prior, data, number=0):
    window = list(windows(range(len(data)).__contains__, 3))[number]
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
    for number, window in enumerate(windows(range(len(data)).__contains__, 3)):
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


def test_a_gpu_computes_in_the_precision_that_the_provenance_says(framework, monkeypatch, weights):
    monkeypatch.setattr(sys.modules["torch"].nn.Module, "to", lambda self, device: self)
    monkeypatch.setattr(sys.modules["torch"].cuda, "is_available", lambda: True)
    described = load(weights, device="cuda", amp="fp16").described
    assert (described["device"], described["amp"]) == ("cuda", "fp16")


def test_a_cpu_that_nobody_asked_for_is_mentioned_and_a_gpu_that_is_not_there_is_an_error(
    framework, capsys, monkeypatch, weights
):
    load(weights, device="cpu")
    assert "finds no GPU" not in capsys.readouterr().err
    monkeypatch.setattr(sys.modules["torch"].cuda, "is_available", lambda: False)
    load(weights, device=None)
    assert "finds no GPU, so prior=mapanything runs on the CPU, which is slow" in capsys.readouterr().err
    with pytest.raises(ValueError, match="device=cuda:1, but torch .* finds no GPU"):
        load(weights, device="cuda:1")


def test_only_what_is_used_is_copied_and_numbers_of_16_bits_become_float32(torch, framework, weights):
    def halved(value):
        tensor = torch.from_numpy(value)
        return tensor.bfloat16() if tensor.is_floating_point() else tensor

    framework[1].infer = Double(framework[0], convert=halved).infer
    images = [np.full((42, 56, 3), i, np.uint8) for i in range(2)]
    views = build_views(images, framework[0].intrinsics, plan_resize((40, 30), (56, 42)), None)
    (output, _) = load(weights).infer(views)
    kinds = {key: value.dtype for key, value in output.items()}
    assert kinds == dict.fromkeys(USED_OUTPUTS, np.float32) | {"non_ambiguous_mask": np.bool_}


def test_rays_that_no_camera_has_are_no_answer_and_no_end(torch, framework, weights):
    """Upstream fits a camera by least squares, and said that a matrix is singular."""
    framework[1].infer = lambda views, **options: torch.linalg.inv(torch.zeros(2, 2))
    prediction = ask(make(weights), framework[0])
    assert not prediction.mask.any() and not prediction.points.any() and (prediction.confidence == 1).all()
    np.testing.assert_array_equal(prediction.T_anchor_view[0], np.eye(4))
    assert np.isnan(prediction.T_anchor_view[1:]).all()
    assert prediction.points.shape == (len(prediction.window.dense), 30, 40, 3)


def test_nothing_is_downloaded_while_a_network_is_loaded(torch, no_network, tmp_path):
    with torch_network.offline(torch):
        with pytest.raises(OSError, match="clone the GitHub repository owner/name"):
            torch.hub.load("owner/name:v1", "entry")
        with pytest.raises(OSError, match="nothing is downloaded at run time"):
            torch.hub.load_state_dict_from_url("https://example.invalid/weights.pth", model_dir=str(tmp_path))
    assert no_network == []


def test_out_of_memory_names_the_window_and_what_to_lower(torch, framework, weights):
    def exhaust(views, **options):
        raise torch.cuda.OutOfMemoryError("tried to allocate 2 GiB")

    framework[1].infer = exhaust
    with pytest.raises(ValueError, match="does not suffice for 3 images of 56x42") as raised:
        ask(make(weights), framework[0])
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
    load(folder)
    write_weights(folder, **shapes) if isinstance(shapes, dict) else (folder / "model.safetensors").write_bytes(shapes)
    with pytest.raises(ValueError, match=rf"{text}.*: repeat hf download"):
        load(folder)

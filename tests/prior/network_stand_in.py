"""Checkpoints for the tests of the loading, where the package mapanything need not be installed."""

import json
from pathlib import Path

import pytest

from emgs_jax.prior.network.framework import ComputeConfig
from emgs_jax.prior.network.torch_network import load_network


def load(checkpoint, device="cpu", amp="bf16"):
    return load_network(checkpoint, ComputeConfig(device, amp, True, 1))


def write_checkpoint(folder: Path, encoder: dict) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "config.json").write_text(json.dumps({"encoder_config": encoder}))
    (folder / "model.safetensors").write_bytes(b"not read")
    return folder


def write_weights(folder: Path, **shapes) -> None:
    """A file of random weights, of the stand-in's names and shapes unless others are given."""
    torch, safetensors = pytest.importorskip("torch"), pytest.importorskip("safetensors.torch")
    shapes = shapes or WEIGHTS
    tensors = {name.replace("__", "."): torch.rand(shape) for name, shape in shapes.items()}
    safetensors.save_file(tensors, str(folder / "model.safetensors"))


def clone(hub: Path) -> Path:
    """A stand-in for DINOv2's repository, with an entry that says what it was asked for."""
    folder = hub / "facebookresearch_dinov2_main"
    folder.mkdir(parents=True)
    (folder / "hubconf.py").write_text("def dinov2_vitg14(pretrained=True):\n    return ('random', pretrained)\n")
    return folder


WEIGHTS = {"head__weight": (2, 3), "head__bias": (2,)}
DINOV2 = {"encoder_str": "dinov2_giant_24_layers", "torch_hub_pretrained": False}

"""The framework's real wrappers of other networks, tiny and with random weights: they answer twice with the same bits.

Each needs a package of its own beside mapanything. VGGT, Pi3, Pi3X and DA3 cannot be made without published weights.
"""

import argparse
import importlib
import re
import sys
import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from network_double import Sphere
from network_stand_in import load

from emgs_jax.prior.network.framework import MODELS, build_views
from emgs_jax.prior.network.resize import plan_resize, resize_image

real_torch = pytest.importorskip("torch", reason="torch is not installed")
models = pytest.importorskip("mapanything.models", reason="the package mapanything is not installed")

SIZE = (64, 48)
SIZES = (
    "enc_depth=1, dec_depth=2, enc_embed_dim=48, dec_embed_dim=48, enc_num_heads=2, dec_num_heads=2, img_size=(64, 48)"
)
DUST3R = (
    f"AsymmetricCroCo3DStereo({SIZES}, pos_embed='RoPE100', patch_embed_cls='PatchEmbedDust3R', head_type='linear', "
    "output_mode='pts3d', depth_mode=('exp', -inf, inf), conf_mode=('exp', 1, inf), landscape_only=False)"
)
MAST3R = (
    "AsymmetricMASt3R(enc_depth=1, dec_depth=12, enc_embed_dim=48, dec_embed_dim=48, enc_num_heads=2, dec_num_heads=2, "
    "img_size=(64, 48), pos_embed='RoPE100', patch_embed_cls='PatchEmbedDust3R', head_type='catmlp+dpt', "
    "output_mode='pts3d+desc24', depth_mode=('exp', -inf, inf), conf_mode=('exp', 1, inf), two_confs=True, "
    "desc_conf_mode=('exp', 0, inf), landscape_only=False)"
)
ENCODER = "Dust3rEncoder(img_size=(512, 512), embed_dim=48, depth=1, num_heads=2)"
DECODER = (
    "MUSt3R(img_size=(512, 512), enc_embed_dim=48, embed_dim=48, depth=2, num_heads=2, feedback_type='single_mlp', "
    "memory_mode='kv', landscape_only=False)"
)
POW3R = (
    f"Pow3R(mode='inject[0]', {SIZES}, pos_embed='RoPE100', head_type='linear_pts3d+conf', "
    "patch_embed_cls='ManyAR_PatchEmbed')"
)


def wrapper(name):
    """The module of a wrapper; the test is skipped where its network's package is absent."""
    try:
        return importlib.import_module(f"mapanything.models.external.{name}")
    except ImportError as error:
        pytest.skip(f"the package of {name} is not installed: {error}")


def dust3r(path):
    module = wrapper("dust3r")
    network = eval(DUST3R, {"inf": float("inf"), **vars(module)})
    real_torch.save({"args": argparse.Namespace(model=DUST3R), "model": network.state_dict()}, path)
    return module.DUSt3RBAWrapper("dust3r", str(path), global_optim_niter=3)


def mast3r(path):
    module = wrapper("mast3r")
    network = eval(MAST3R, {"inf": float("inf"), **vars(sys.modules["mast3r.model"])})
    for head in (network.downstream_head1, network.downstream_head2):
        head.dpt.head[-1].bias.data[2] = 3  # in front of the camera, as the alignment demands
    real_torch.save({"args": argparse.Namespace(model=MAST3R), "model": network.state_dict()}, path)
    few = {"sparse_ga_niter1": 3, "sparse_ga_niter2": 3, "sparse_ga_matching_conf_thr": 0.0}
    return module.MASt3RSGAWrapper("mast3r", str(path), str(path.parent / "is replaced"), **few)


def must3r(path):
    module = wrapper("must3r")
    package = vars(sys.modules["must3r.model"])
    encoder, decoder = (eval(text, dict(package)) for text in (ENCODER, DECODER))
    arguments = argparse.Namespace(encoder=ENCODER, decoder=DECODER)
    weights = {"args": arguments, "encoder": encoder.state_dict(), "decoder": decoder.state_dict()}
    real_torch.save(weights, path)
    load = module.load_model
    module.load_model = partial(load, device="cpu")  # it is made on a GPU, whatever device is asked for
    try:
        return module.MUSt3RWrapper("must3r", str(path), None)
    finally:
        module.load_model = load


def pow3r_ba(path):
    module = wrapper("pow3r")
    network = eval(POW3R, vars(module))
    real_torch.save({"definition": POW3R, "weights": network.state_dict()}, path)
    only_images = {"overall_prob": 0, "ray_dirs_prob": 0, "depth_prob": 0, "cam_prob": 0}
    return module.Pow3RBAWrapper("pow3r_ba", str(path), only_images, global_optim_niter=3)


@pytest.mark.parametrize("make", [dust3r, mast3r, must3r, pow3r_ba], ids=lambda make: make.__name__)
def test_the_wrapper_answers_with_geometry_and_twice_with_the_same_bits(make, monkeypatch, tmp_path):
    real_torch.manual_seed(0)

    def configured(name, device):
        return make(tmp_path / "weights.pth").to(device)

    monkeypatch.setattr(models, "init_model_from_config", configured)
    name = make.__name__
    monkeypatch.setitem(MODELS, name, replace(MODELS[name], needs_gpu=False))
    network, data, resize = load(name), Sphere(num_frames=3, size=SIZE), plan_resize(SIZE, SIZE)
    rng = np.random.default_rng(0)
    images = [resize_image(rng.integers(0, 256, (*SIZE[::-1], 3), np.uint8), resize) for _ in range(3)]
    first, second = (network.infer(build_views(images, data.intrinsics, resize, MODELS[name], None)) for _ in range(2))
    assert [set(output) - {"conf"} for output in first] == [{"pts3d_cam", "camera_poses", "intrinsics"}] * 3
    for output, same in zip(first, second, strict=True):
        assert output["pts3d_cam"].shape == (1, *SIZE[::-1], 3) and output["camera_poses"].shape == (1, 4, 4)
        for key, value in output.items():
            np.testing.assert_array_equal(value, same[key])


CLONE = Path(models.__file__).parents[2]


@pytest.mark.parametrize("name", [name for name, known in MODELS.items() if known.precision not in ("", "infer")])
def test_the_wrapper_keeps_its_precision_where_it_is_put(name):
    module = {"vggt_commercial": "vggt", "da3_nested": "da3"}.get(name, name)
    text = (CLONE / "mapanything" / "models" / "external" / module / "__init__.py").read_text()
    assert re.search(rf"(dtype=|\n\s+)self\.{MODELS[name].precision}\b", text.split("def forward")[1])


def test_the_extras_are_those_of_the_framework():
    path = CLONE / "pyproject.toml"
    if not path.is_file():
        pytest.skip("mapanything is not installed from a clone")
    extras = tomllib.loads(path.read_text())["project"]["optional-dependencies"]
    assert {known.extra for known in MODELS.values()} - {""} <= set(extras)

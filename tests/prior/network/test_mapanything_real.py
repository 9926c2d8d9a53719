"""The real package with a tiny random MapAnything: interfaces only, since random weights give no geometry."""

import json
from math import inf

import hydra
import numpy as np
import pytest
from network_double import Sphere
from tiny_run import compose

from emgs_jax.prior.base import windows

torch = pytest.importorskip("torch", reason="torch is not installed")
models = pytest.importorskip("mapanything.models", reason="the package mapanything is not installed")
safetensors = pytest.importorskip("safetensors.torch", reason="safetensors is not installed")

WIDTH = 32


def geometric(name, channels, kind):
    config = {"name": name, "in_chans": channels, "encoder_str": kind, "intermediate_dims": [8, 16]}
    return config | ({"apply_pe": False} if kind == "dense_rep_encoder" else {})


def tiny():
    """Arguments of the smallest MapAnything; its encoder needs no download."""
    bounds = {"ray_directions_vmin": -inf, "ray_directions_vmax": inf, "ray_directions_z_dir_min": -inf}
    return {
        "name": "mapanything_tiny",
        "info_sharing_mlp_layer_str": "swiglufused",
        "use_register_tokens_from_encoder": True,
        "encoder_config": {
            "encoder_str": "patch_embedder",
            "name": "tiny",
            "data_norm_type": "dinov2",
            "patch_size": 14,
            "enc_embed_dim": WIDTH,
            "input_size": 56,
            "uses_torch_hub": False,
        },
        "info_sharing_config": {
            "model_type": "alternating_attention",
            "model_return_type": "intermediate_features",
            "custom_positional_encoding": None,
            "module_args": {
                "name": "tiny_aat",
                "indices": [1, 2],
                "norm_intermediate": True,
                "size": "4_layers",
                "depth": 4,
                "distinguish_ref_and_non_ref_views": True,
                "gradient_checkpointing": False,
                "dim": WIDTH,
                "num_heads": 2,
                "mlp_ratio": 2,
                "qkv_bias": True,
                "qk_norm": False,
                "init_values": 1e-5,
            },
        },
        "pred_head_config": {
            "type": "dpt+pose",
            "feature_head": {
                "feature_dim": 16,
                "hooks": [0, 1, 2, 3],
                "layer_dims": [8, 8, 16, 16],
                "checkpoint_gradient": False,
            },
            "regressor_head": {"output_dim": 6, "checkpoint_gradient": False},
            "pose_head": {"num_resconv_block": 1, "rot_representation_dim": 4},
            "scale_head": {"output_dim": 1, "hidden_dim": 16},
            "adaptor_type": "raydirs+depth+pose+confidence+mask",
            "dpt_adaptor": bounds
            | {
                "name": "a",
                "ray_directions_mode": "linear",
                "ray_directions_normalize_to_unit_sphere": True,
                "ray_directions_normalize_to_unit_image_plane": False,
                "ray_directions_clamp_min_of_z_dir": False,
                "depth_mode": "exp",
                "depth_vmin": 0,
                "depth_vmax": inf,
                "confidence_type": "exp",
                "confidence_vmin": 1,
                "confidence_vmax": inf,
            },
            "pose_adaptor": {
                "name": "a",
                "cam_trans_mode": "linear",
                "cam_trans_vmin": -inf,
                "cam_trans_vmax": inf,
                "quaternions_mode": "linear",
                "quaternions_normalize": True,
                "quaternions_vmin": -inf,
                "quaternions_vmax": inf,
            },
            "scale_adaptor": {"name": "a", "mode": "exp", "vmin": 1e-8, "vmax": inf},
        },
        "geometric_input_config": {
            "ray_dirs_encoder_config": geometric("r", 3, "dense_rep_encoder"),
            "depth_encoder_config": geometric("d", 1, "dense_rep_encoder"),
            "cam_rot_encoder_config": geometric("q", 4, "global_rep_encoder"),
            "cam_trans_encoder_config": geometric("t", 3, "global_rep_encoder"),
            "scale_encoder_config": geometric("s", 1, "global_rep_encoder"),
            "overall_prob": 0,
            "dropout_prob": 1,
            "ray_dirs_prob": 0,
            "depth_prob": 0,
            "cam_prob": 0,
            "sparse_depth_prob": 0,
            "sparsification_removal_percent": 0,
            "depth_scale_norm_all_prob": 0,
            "pose_scale_norm_all_prob": 0,
        },
    }


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """A local folder as the published ones are."""
    folder = tmp_path_factory.mktemp("checkpoint")
    (folder / "config.json").write_text(json.dumps(tiny()))  # before the constructor changes the dicts
    torch.manual_seed(0)
    safetensors.save_model(models.MapAnything(**tiny()), str(folder / "model.safetensors"))
    return folder


def predict(checkpoint, *overrides):
    keys = ("masks.drop_ambiguous=0", "masks.max_edge_step=inf", "compute.device=cpu", *overrides)
    names = (f"prior.checkpoint={checkpoint}", "prior.resolution=[84,56]", *(f"prior.{key}" for key in keys))
    prior = hydra.utils.instantiate(compose("prior=mapanything", *names).prior)
    data = Sphere(num_frames=4, size=(60, 40))
    calls = list(windows(len(data), 3))
    return [prior.predict(window, [data[i] for i in window.views], data.intrinsics) for window in calls]


def test_a_local_checkpoint_predicts_the_record_that_the_mapping_takes(checkpoint):
    for prediction in predict(checkpoint):
        dense, views = len(prediction.window.dense), len(prediction.window.views)
        assert prediction.points.shape == (dense, 40, 60, 3) and prediction.points.dtype == np.float32
        assert prediction.T_anchor_view.shape == (views, 4, 4) and prediction.T_anchor_view.dtype == np.float64
        np.testing.assert_array_equal(prediction.T_anchor_view[0], np.eye(4))
        rotations = prediction.T_anchor_view[:, :3, :3]
        np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (views, 1, 1)), atol=1e-5)
        assert np.isfinite(prediction.points).all() and prediction.confidence.min() >= 1


def test_the_same_window_gives_the_same_bits(checkpoint):
    for a, b in zip(predict(checkpoint), predict(checkpoint), strict=True):
        assert a.points.tobytes() == b.points.tobytes() and a.T_anchor_view.tobytes() == b.T_anchor_view.tobytes()


def test_the_anchors_pose_and_its_metric_flag_change_what_comes_out(checkpoint):
    answers = [
        predict(checkpoint, key)[0].T_anchor_view
        for key in ("anchor_pose=on", "anchor_pose=off", "anchor_is_metric=true")
    ]
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(answers[one] - answers[other]).max() > 0


def test_weights_that_leave_a_parameter_of_the_real_model_random_are_refused(checkpoint, tmp_path):
    """`from_pretrained` took them, and every process predicted something else."""
    tensors = safetensors.load_file(str(checkpoint / "model.safetensors"))
    name = next(name for name in tensors if name.endswith("weight"))
    (tmp_path / "config.json").write_bytes((checkpoint / "config.json").read_bytes())
    renamed = {("other." + key if key == name else key): value for key, value in tensors.items()}
    safetensors.save_file(renamed, str(tmp_path / "model.safetensors"))
    with pytest.raises(hydra.errors.InstantiationException) as raised:
        predict(tmp_path)
    said = str(raised.value.__cause__)
    assert f"1 missing ({name}) and 1 that it does not have (other.{name})" in said and str(tmp_path) in said

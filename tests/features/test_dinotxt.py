"""The two parts of dino.txt against layers of `transformers` that compute the same with the same weights."""

import pytest

torch = pytest.importorskip("torch", reason="dino.txt runs in PyTorch")
transformers = pytest.importorskip("transformers", reason="its layers are the oracle")

from tiny_dino import NUM_HEADS, random_head, random_text_encoder  # noqa: E402

from emgs_jax.features.dinotxt import text_tower, vision_head  # noqa: E402

pytestmark = pytest.mark.slow

DIM = 16


def test_the_vision_head_is_two_gated_layers_without_positions_and_a_norm():
    from transformers.models.dinov3_vit.modeling_dinov3_vit import DINOv3ViTLayer

    weights = random_head(DIM)
    config = transformers.DINOv3ViTConfig(
        hidden_size=DIM, intermediate_size=24, num_attention_heads=NUM_HEADS, use_gated_mlp=True, hidden_act="silu",
        query_bias=False, value_bias=False, key_bias=False, attn_implementation="eager",
    )  # fmt: skip
    tokens = torch.randn(1, 7, DIM, generator=torch.manual_seed(1))
    expected = tokens
    for number in range(2):
        block = {
            k.removeprefix(f"blocks.{number}."): v for k, v in weights.items() if k.startswith(f"blocks.{number}.")
        }
        layer = DINOv3ViTLayer(config).eval()
        query, key, value = block["attn.qkv.weight"].chunk(3)
        state = {f"attention.{n}_proj.weight": w for n, w in (("q", query), ("k", key), ("v", value))}
        names = {"attn.proj": "attention.o_proj", "mlp.w1": "mlp.gate_proj", "mlp.w2": "mlp.up_proj"}
        names |= {"mlp.w3": "mlp.down_proj", "norm1": "norm1", "norm2": "norm2"}
        for ours, theirs in names.items():
            state |= {f"{theirs}.{kind}": block[f"{ours}.{kind}"] for kind in ("weight", "bias")}
        state |= {f"layer_scale{n}.lambda1": block[f"ls{n}.gamma"] for n in (1, 2)}
        layer.load_state_dict(state)
        # Cosine 1 and sine 0 turn nothing: the head has no positions.
        turn = torch.ones(7, DIM // NUM_HEADS), torch.zeros(7, DIM // NUM_HEADS)
        expected = layer(expected, position_embeddings=turn)
    expected = torch.nn.functional.layer_norm(expected, (DIM,), weights["ln_final.weight"], weights["ln_final.bias"])
    torch.testing.assert_close(vision_head(tokens, weights, NUM_HEADS), expected.detach(), atol=1e-5, rtol=1e-5)


def test_the_text_tower_is_clips_with_an_exact_gelu():
    weights = random_text_encoder(DIM, num_tokens=30, length=9, out=20)
    config = transformers.CLIPTextConfig(
        vocab_size=30, hidden_size=DIM, intermediate_size=24, num_hidden_layers=2, num_attention_heads=NUM_HEADS,
        max_position_embeddings=9, hidden_act="gelu", projection_dim=20, eos_token_id=29, pad_token_id=0,
        bos_token_id=28,
    )  # fmt: skip
    model = transformers.CLIPTextModelWithProjection(config).eval()
    state = model.state_dict()
    prefix = next(name for name in state if name.endswith("token_embedding.weight")).split("embeddings.")[0]
    state["text_projection.weight"] = weights["head.linear_projection.weight"]
    state[f"{prefix}embeddings.token_embedding.weight"] = weights["backbone.token_embedding.weight"]
    state[f"{prefix}embeddings.position_embedding.weight"] = weights["backbone.positional_embedding"]
    for kind in ("weight", "bias"):
        state[f"{prefix}final_layer_norm.{kind}"] = weights[f"backbone.ln_final.{kind}"]
    for number in range(2):
        ours, theirs = f"backbone.blocks.{number}.", f"{prefix}encoder.layers.{number}."
        for name, part in zip("qkv", weights[f"{ours}attention.qkv.weight"].chunk(3), strict=True):
            state[f"{theirs}self_attn.{name}_proj.weight"] = part
            state[f"{theirs}self_attn.{name}_proj.bias"] = torch.zeros(DIM)
        names = {"attention.proj": "self_attn.out_proj", "attention_norm": "layer_norm1", "ffn_norm": "layer_norm2"}
        names |= {"feed_forward.fc1": "mlp.fc1", "feed_forward.fc2": "mlp.fc2"}
        for name, other in names.items():
            state |= {f"{theirs}{other}.{kind}": weights[f"{ours}{name}.{kind}"] for kind in ("weight", "bias")}
    model.load_state_dict(state)
    tokens = torch.tensor([[28, 5, 7, 29, 0, 0, 0, 0, 0], [28, 1, 2, 3, 4, 5, 6, 7, 29]])
    with torch.inference_mode():
        expected = model(tokens).text_embeds
    torch.testing.assert_close(text_tower(tokens, weights, NUM_HEADS), expected, atol=1e-5, rtol=1e-5)

"""The two transformers that dino.txt adds to a DINO backbone, as functions of their published weights.

`weights` maps names within the part, such as `blocks.0.norm1.weight`, to PyTorch tensors. Both are pre-norm.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

Weights = Mapping[str, "Tensor"]


def vision_head(tokens: "Tensor", weights: Weights, num_heads: int) -> "Tensor":
    """Align a backbone's normed tokens (b, n, d) with text: blocks without positions, SwiGLU, layer scale, a norm."""
    from torch.nn.functional import silu

    for block in _blocks(weights):
        attended = _attention(_norm(tokens, block, "norm1"), block, "attn", num_heads)
        tokens = tokens + block["ls1.gamma"] * attended
        inside = _norm(tokens, block, "norm2")
        gated = silu(_linear(inside, block, "mlp.w1")) * _linear(inside, block, "mlp.w2")
        tokens = tokens + block["ls2.gamma"] * _linear(gated, block, "mlp.w3")
    return _norm(tokens, weights, "ln_final")


def text_tower(tokens: "Tensor", weights: Weights, num_heads: int) -> "Tensor":
    """Encode tokens (t, n) of `Tokenizer` as vectors (t, 2 d): causal blocks, the state at the largest (end) token."""
    from torch.nn.functional import gelu

    backbone = _part(weights, "backbone.")
    states = backbone["token_embedding.weight"][tokens] + backbone["positional_embedding"][: tokens.shape[1]]
    for block in _blocks(backbone):
        inside = _norm(states, block, "attention_norm")
        states = states + _attention(inside, block, "attention", num_heads, is_causal=True)
        hidden = gelu(_linear(_norm(states, block, "ffn_norm"), block, "feed_forward.fc1"))
        states = states + _linear(hidden, block, "feed_forward.fc2")
    at_end = _norm(states, backbone, "ln_final")[range(len(tokens)), tokens.argmax(dim=-1)]
    return _linear(at_end, weights, "head.linear_projection")


def _part(weights: Weights, prefix: str) -> Weights:
    return {name.removeprefix(prefix): value for name, value in weights.items() if name.startswith(prefix)}


def _blocks(weights: Weights) -> list[Weights]:
    count = 1 + max(int(name.split(".")[1]) for name in weights if name.startswith("blocks."))
    return [_part(weights, f"blocks.{number}.") for number in range(count)]


def _linear(values: "Tensor", weights: Weights, name: str) -> "Tensor":
    from torch.nn.functional import linear

    return linear(values, weights[f"{name}.weight"], weights.get(f"{name}.bias"))


def _norm(values: "Tensor", weights: Weights, name: str) -> "Tensor":
    from torch.nn.functional import layer_norm

    return layer_norm(values, values.shape[-1:], weights[f"{name}.weight"], weights[f"{name}.bias"])


def _attention(values: "Tensor", weights: Weights, name: str, num_heads: int, is_causal: bool = False) -> "Tensor":
    from torch.nn.functional import scaled_dot_product_attention

    batch, length, size = values.shape
    qkv = _linear(values, weights, f"{name}.qkv").reshape(batch, length, 3, num_heads, size // num_heads)
    heads = scaled_dot_product_attention(*qkv.permute(2, 0, 3, 1, 4), is_causal=is_causal)
    return _linear(heads.transpose(1, 2).reshape(batch, length, size), weights, f"{name}.proj")

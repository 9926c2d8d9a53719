"""Tiny random checkpoints of a DINO backbone with dino.txt, as their publishers lay them out; needs PyTorch."""

import gzip
from pathlib import Path

import torch
import transformers

from emgs_jax.features.checkpoint import DinoFiles

NUM_HEADS, DIM, TEXT_DIM, NUM_TOKENS, LENGTH = 2, 16, 12, 516, 10
MERGES = ["w a", "l l</w>"]


def drawn(shapes: dict[str, tuple[int, ...]], seed: int) -> dict[str, torch.Tensor]:
    generator = torch.manual_seed(seed)
    return {name: 0.5 * torch.randn(shape, generator=generator) for name, shape in shapes.items()}


def random_head(dim: int, blocks: str = "blocks") -> dict[str, torch.Tensor]:
    """Weights of a vision head whose layers all matter; `blocks` is DINOv3's name for them."""
    shapes = {"attn.qkv.weight": (3 * dim, dim), "ls1.gamma": (dim,), "ls2.gamma": (dim,)}
    shapes |= {f"{norm}.{kind}": (dim,) for norm in ("norm1", "norm2") for kind in ("weight", "bias")}
    for name, out, inside in (("attn.proj", dim, dim), ("mlp.w1", 24, dim), ("mlp.w2", 24, dim), ("mlp.w3", dim, 24)):
        shapes |= {f"{name}.weight": (out, inside), f"{name}.bias": (out,)}
    shapes = {f"{blocks}.{number}.{name}": shape for number in (0, 1) for name, shape in shapes.items()}
    shapes |= {"ln_final.weight": (dim,), "ln_final.bias": (dim,)}
    return drawn(shapes, 0)


def random_text_encoder(dim: int, num_tokens: int, length: int, out: int) -> dict[str, torch.Tensor]:
    """Weights of a text tower."""
    shapes = {"attention.qkv.weight": (3 * dim, dim)}
    for name in ("attention_norm", "ffn_norm"):
        shapes |= {f"{name}.weight": (dim,), f"{name}.bias": (dim,)}
    linear = ("attention.proj", dim, dim), ("feed_forward.fc1", 24, dim), ("feed_forward.fc2", dim, 24)
    for name, rows, columns in linear:
        shapes |= {f"{name}.weight": (rows, columns), f"{name}.bias": (rows,)}
    shapes = {f"blocks.{number}.{name}": shape for number in (0, 1) for name, shape in shapes.items()}
    shapes |= {"token_embedding.weight": (num_tokens, dim), "positional_embedding": (length, dim)}
    shapes |= {"ln_final.weight": (dim,), "ln_final.bias": (dim,)}
    shapes = {f"backbone.{name}": shape for name, shape in shapes.items()} | {
        "head.linear_projection.weight": (out, dim)
    }
    return drawn(shapes, 1)


def dinov3(dim: int = DIM) -> torch.nn.Module:
    """A backbone with patches of 16 pixels and 4 registers."""
    torch.manual_seed(2)
    config = transformers.DINOv3ViTConfig(
        hidden_size=dim, num_hidden_layers=2, num_attention_heads=NUM_HEADS, intermediate_size=24,
        num_register_tokens=4, patch_size=16, image_size=64,
    )  # fmt: skip
    return transformers.DINOv3ViTModel(config).eval()


def dinov2(dim: int = DIM) -> torch.nn.Module:
    """A backbone with patches of 14 pixels and 4 registers."""
    torch.manual_seed(3)
    config = transformers.Dinov2WithRegistersConfig(
        hidden_size=dim, num_hidden_layers=2, num_attention_heads=NUM_HEADS, mlp_ratio=2, num_register_tokens=4,
        patch_size=14, image_size=56,
    )  # fmt: skip
    return transformers.Dinov2WithRegistersModel(config).eval()


def write_checkpoint(folder: Path, backbone: torch.nn.Module, is_one_file: bool) -> DinoFiles:
    """Write backbone, dino.txt and vocabulary; DINOv3 has both parts in one file, DINOv2 one file for each."""
    backbone.save_pretrained(folder, safe_serialization=True)
    dim = backbone.config.hidden_size
    head = random_head(dim, "blocks" if is_one_file else "block_list")
    text = random_text_encoder(TEXT_DIM, NUM_TOKENS, LENGTH, 2 * dim)
    if is_one_file:
        state = {f"visual_model.head.{name}": value for name, value in head.items()}
        state |= {f"text_model.{name}": value for name, value in text.items()} | {"logit_scale": torch.ones(1)}
        torch.save(state, folder / "dinotxt.pth")
    else:
        torch.save(head, folder / "head.pth")
        torch.save(text, folder / "text.pth")
    (folder / "bpe.txt.gz").write_bytes(gzip.compress(("#version\n" + "\n".join(MERGES) + "\n").encode()))
    names = ("dinotxt.pth", "dinotxt.pth") if is_one_file else ("head.pth", "text.pth")
    return DinoFiles(*names, "bpe.txt.gz", "the tests")

"""Folders of weights: check that files are there, and read them without running code."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

BACKBONE = ("config.json", "model.safetensors")  # as Hugging Face publishes them


@dataclass(frozen=True)
class DinoFiles:
    """Names within the folder of the checkpoint, beside the backbone's config.json and model.safetensors."""

    vision_head: str = "dinov3_vitl16_dinotxt_vision_head_and_text_encoder-a442d8f5.pth"  # weights of dino.txt
    # weights of dino.txt, perhaps the same file
    text_encoder: str = "dinov3_vitl16_dinotxt_vision_head_and_text_encoder-a442d8f5.pth"
    vocabulary: str = "bpe_simple_vocab_16e6.txt.gz"  # of CLIP
    source: str = "facebook/dinov3-vitl16-pretrain-lvd1689m on Hugging Face and facebookresearch/dinov3 on GitHub"


def require(folder: str, names: Sequence[str], source: str) -> list[Path]:
    """The paths of `names` in `folder`; ValueError if some are missing."""
    path = Path(folder).expanduser()
    missing = [name for name in dict.fromkeys(names) if not (path / name).is_file()]
    if missing:
        raise ValueError(
            f"features.checkpoint={folder} lacks {', '.join(missing)}: put the files there (nothing is downloaded), "
            f"from {source}"
        )
    return [path / name for name in names]


def digest(path: Path) -> str:
    with open(path, "rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def load_part(path: Path, prefix: str, needed: str) -> dict[str, "Tensor"]:
    """Load float32 weights of a .pth file, those under `prefix` if it holds more; ValueError if `needed` is missing."""
    import torch

    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a broken archive raises a dozen types
        raise ValueError(f"{path} is no file of weights, or damaged ({error}): fetch it again") from error
    state = state if isinstance(state, dict) else {}
    part = {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)} or state
    # DINOv2's file has another name for the blocks of its head than DINOv3's.
    part = {name.replace("block_list.", "blocks.", 1): value for name, value in part.items()}
    if needed not in part:
        raise ValueError(f"{path} has no {prefix}{needed}: it is not this part of dino.txt, or of another version")
    return {name: value.float() for name, value in part.items()}

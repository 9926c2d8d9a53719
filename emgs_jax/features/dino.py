"""dino.txt on a DINO backbone: patch features that text can be compared with. Nothing is downloaded.

The patch tokens of the backbone are not aligned with text; those of dino.txt's vision head are, with the second half of
the text encoder's vector. The first half belongs to the class token.
"""

import importlib.util
from collections.abc import Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from emgs_jax.data.base import Frame
from emgs_jax.features.base import FeatureModel
from emgs_jax.features.checkpoint import BACKBONE, DinoFiles, digest, load_part, require
from emgs_jax.features.dinotxt import text_tower, vision_head
from emgs_jax.features.images import ImageConfig, grid_size, network_input
from emgs_jax.features.text import TextEmbeddings, average_over_templates, check_templates
from emgs_jax.features.tokens import Tokenizer
from emgs_jax.io.packages import best_device, companion_problem, first_line

if TYPE_CHECKING:
    from torch import Tensor


class DinoText(FeatureModel):
    """Text-aligned patch features of dino.txt.

    Args:
        name: of the model; embeddings of another name are refused.
        checkpoint: folder of the weights, `files` the names in it.
        num_registers: of the backbone that dino.txt was trained on.
        num_text_heads: of the text encoder's attention.
        device: of PyTorch; None: a GPU if there is one.
        classes: names to embed, or to choose from `text`.
        templates: prompts over which an embedding is the mean.
        text: file of `experiments.embed`, in place of text encoder and vocabulary.
    """

    def __init__(
        self,
        name: str,
        checkpoint: str,
        files: DinoFiles,
        num_registers: int,
        image: ImageConfig,
        num_text_heads: int,
        device: str | None,
        classes: Sequence[str],
        templates: Sequence[str],
        text: str | None,
    ) -> None:
        absent = [package for package in ("torch", "transformers") if importlib.util.find_spec(package) is None]
        if absent:
            raise ValueError(f"features={name} needs {' and '.join(absent)}: pip install 'emgs_jax[features]'")
        check_templates(templates)
        self._name, self._folder, self._files, self._image = name, checkpoint, files, image
        self._num_registers, self._num_text_heads = int(num_registers), num_text_heads
        self._device = device or best_device(importlib.import_module("torch"), f"features={name}", "features.device")
        self._classes, self._templates, self._file = tuple(classes), tuple(templates), text

    def _paths(self, *names: str) -> list[Path]:
        return require(self._folder, names, self._files.source)

    @cached_property
    def identity(self) -> dict:
        return {"name": self._name, "version": 1, "vision_head": digest(*self._paths(self._files.vision_head))}

    @cached_property
    def settings(self) -> dict:
        needed = [*BACKBONE, self._files.vision_head]
        if self._classes and self._file is None:
            needed += self._files.text_encoder, self._files.vocabulary
        image = {key: _plain(value) for key, value in asdict(self._image).items()}
        return {"backbone": digest(self._paths(*needed)[1]), "image": image}

    def embed(self, names: tuple[str, ...]) -> TextEmbeddings:
        """Encode the prompts of each name; the mean of the half that is aligned with patches."""
        import torch

        if not names:
            vectors = np.zeros((0, self._vision[0].config.hidden_size), np.float32)
            return TextEmbeddings((), vectors, self._templates, self.identity)
        encoder, vocabulary, _ = self._paths(self._files.text_encoder, self._files.vocabulary, self._files.vision_head)
        weights = load_part(encoder, "text_model.", "backbone.token_embedding.weight")
        sizes = len(weights["backbone.token_embedding.weight"]), len(weights["backbone.positional_embedding"])
        tokenizer = Tokenizer(vocabulary, *sizes)
        weights = {name: value.to(self._device) for name, value in weights.items()}

        def encode(prompts: list[str]) -> np.ndarray:
            with torch.inference_mode():
                tokens = torch.from_numpy(tokenizer(prompts)).to(self._device)
                vectors = text_tower(tokens, weights, self._num_text_heads)
            return vectors[:, vectors.shape[1] // 2 :].cpu().numpy()

        vectors = average_over_templates(names, self._templates, encode)
        return TextEmbeddings(tuple(names), vectors, self._templates, self.identity)

    def extract(self, frame: Frame) -> np.ndarray:
        """The unit tokens of the vision head, float16 (rows, columns, f), one per patch."""
        import torch

        image = frame.image
        backbone, head = self._vision
        patch = int(backbone.config.patch_size)
        columns, rows = grid_size(image.shape[1::-1], patch, self._image.long_side)
        values = network_input(image, (columns, rows), patch, self._image)
        try:
            with torch.inference_mode():
                tokens = backbone(torch.from_numpy(values)[None].to(self._device)).last_hidden_state
                tokens = vision_head(tokens, head, backbone.config.num_attention_heads)
        except torch.cuda.OutOfMemoryError as error:
            raise ValueError(
                f"the GPU has no memory for {columns}x{rows} patches: lower features.image.long_side="
                f"{self._image.long_side} or set features.device=cpu; what is recorded stays valid"
            ) from error
        return patch_grid(tokens, (columns, rows)).cpu().numpy().astype(np.float16)

    @cached_property
    def _vision(self) -> tuple[Any, dict[str, "Tensor"]]:
        """The backbone, and the weights of the head."""
        *_, path = self._paths(*BACKBONE, self._files.vision_head)
        head = load_part(path, "visual_model.head.", "ln_final.weight")
        backbone = read_backbone(path.parent, self._files.source)
        registers = getattr(backbone.config, "num_register_tokens", 0)
        for what, wanted, found in (
            ("registers", self._num_registers, registers),
            ("channels", len(head["ln_final.weight"]), backbone.config.hidden_size),
        ):
            if found != wanted:
                raise ValueError(
                    f"{path} is for a backbone with {wanted} {what}, the one in {path.parent} has {found}: "
                    f"take the backbone that {self._files.source} names"
                )
        return backbone.eval().float().to(self._device), {name: value.to(self._device) for name, value in head.items()}


def read_backbone(folder: Path, source: str) -> Any:
    """Load Hugging Face's model; ValueError if its files are damaged or do not fit, or transformers does not load."""
    import transformers

    remedy = f"fetch config.json and model.safetensors again, from {source}"
    try:
        backbone, loaded = transformers.AutoModel.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except Exception as error:  # each of its readers raises its own type
        problem = companion_problem()
        if problem is not None:
            raise ValueError(f"transformers cannot load its model of {folder}: {problem}") from error
        raise ValueError(f"{folder} holds no backbone that can be read ({first_line(error)}): {remedy}") from error
    wrong = [
        f"{len(names)} {word} ({', '.join(map(str, names[:3]))}{', …' if len(names) > 3 else ''})"
        for word, key in (("missing", "missing_keys"), ("that it does not have", "unexpected_keys"))
        if (names := sorted(loaded[key]))
    ]
    if wrong:
        raise ValueError(
            f"{folder / 'model.safetensors'} does not fit the model of its config.json, {' and '.join(wrong)}: {remedy}"
        )
    return backbone


def patch_grid(tokens: "Tensor", grid: tuple[int, int]) -> "Tensor":
    """The unit patch tokens (rows, columns, d) of tokens (1, n, d), in which class token and registers come first."""
    columns, rows = grid
    patches = tokens[0, -rows * columns :].float()
    return (patches / patches.norm(dim=-1, keepdim=True)).reshape(rows, columns, -1)


def _plain(value: Any) -> Any:
    return value if isinstance(value, int) else [float(item) for item in value]

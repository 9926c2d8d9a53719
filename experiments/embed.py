"""Embed class names: `python -m experiments.embed features=dinov3_text 'classes=[wall,floor,chair]' out=FILE`.

With `features.text=FILE` a run compares the features with these classes and needs no text model.
"""

from pathlib import Path

from omegaconf import DictConfig

from emgs_jax.config.configure import build
from emgs_jax.features.text import save_text

from .command import command


def embed(config: DictConfig) -> Path:
    """Write the embeddings of `config.classes` to `config.out`, and print what was written."""
    if "_target_" not in config.features:
        raise ValueError("features=none has no text encoder: choose features=dinov3_text or dinov2_text")
    names = tuple(str(name) for name in config.classes)
    if not names or len(set(names)) < len(names):
        raise ValueError(f"classes must name at least one class, each once, got {[*names]}")
    text = build(config, "features", classes=names, text=None).embed(names)
    path = Path(config.out)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_text(path, text)
    print(f"{path}: {len(names)} classes of width {text.vectors.shape[1]}, {path.stat().st_size / 2**10:.1f} KiB")
    print(f"model {text.model}, {len(text.templates)} templates")
    return path


main = command("embed")(embed)

if __name__ == "__main__":
    main()

"""The device of JAX, and one GPU for it and for the networks that run in PyTorch beside it."""

import os
import re

from omegaconf import DictConfig, OmegaConf

# Where a config says so, and where it has the words that will.
IN_TORCH = re.compile(
    r"emgs_jax\.prior\.network\.|emgs_jax\.features\.dino\.|prior[=:] ?mapanything|features[=:] ?dinov\d_text"
)


def leave_memory_to_torch(config: DictConfig) -> None:
    """Let JAX take the GPU's memory as it needs it where a network runs in PyTorch; else it takes three quarters first.

    It has to be called before JAX's first array. A value of XLA_PYTHON_CLIENT_PREALLOCATE that is there stays.
    """
    if IN_TORCH.search(OmegaConf.to_yaml(config)):
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")


def check_platforms() -> None:
    """ValueError where JAX_PLATFORMS asks for a device that JAX does not find; it says so without a word of its own."""
    platforms = os.environ.get("JAX_PLATFORMS", "")
    if platforms in ("", "cpu"):
        return  # without importing JAX, which not all commands need
    import jax  # noqa: PLC0415

    try:
        jax.devices()
    except (AssertionError, RuntimeError) as error:
        raise ValueError(
            f"JAX_PLATFORMS={platforms}, and JAX finds no such device{f' ({error})' if str(error) else ''}: install "
            'JAX for it (pip install -U "jax[cuda13]" for an NVIDIA GPU), or unset JAX_PLATFORMS'
        ) from error

"""One GPU for JAX and for the networks that run in PyTorch beside it."""

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

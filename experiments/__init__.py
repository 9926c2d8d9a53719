"""Commands, and what must happen before any of them imports JAX."""

import sys

import emgs_jax  # noqa: F401 (it limits JAX's log)

from .interrupt import end_clearly

if sys.argv[:1] == ["-m"]:  # python -m experiments.NAME imports this before NAME's libraries
    end_clearly()

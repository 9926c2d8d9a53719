"""Commands; what has to be so before any of them imports JAX."""

import sys

import emgs_jax  # noqa: F401 (it says to JAX what not to print)

from .interrupt import end_clearly

if sys.argv[:1] == ["-m"]:  # python -m experiments.NAME imports this first, and NAME's libraries next
    end_clearly()

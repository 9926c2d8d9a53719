"""Commands; what has to be so before any of them imports JAX."""

import os
import sys

from .interrupt import end_clearly

# jaxlib 0.10.1 logs an error for every executable that it reads from a cache, for a hint to the compiler that no CPU
# lists as a feature. What does fail raises an exception.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

if sys.argv[:1] == ["-m"]:  # python -m experiments.NAME imports this first, and NAME's libraries next
    end_clearly()

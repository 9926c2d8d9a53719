"""Commands; what has to be so before any of them imports JAX."""

import os

# jaxlib 0.10.1 calls every executable that it reads from a cache an error, for a hint to the compiler that is no feature
# of a CPU. What does fail raises an exception.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

"""Programs that are compiled side by side before they are needed."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor


def compile_all(compilations: Sequence[Callable[[], object]], is_wanted: Callable[[], bool] = lambda: True) -> None:
    """Call functions that each compile something, on as many cores as there are.

    Args:
        is_wanted: asked before each; where it is not, the rest is left.
    """
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        list(threads.map(lambda compilation: compilation() if is_wanted() else None, compilations))

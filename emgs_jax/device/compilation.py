"""Programs that are compiled side by side before they are needed, and what a progress bar says meanwhile."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

_stages = [0, 0]  # compiled so far, and all


def compile_all(compilations: Sequence[Callable[[], object]], is_wanted: Callable[[], bool] = lambda: True) -> None:
    """Call functions that each compile something, on as many cores as there are.

    Args:
        is_wanted: asked before each; where it is not, the rest is left.
    """

    def count(compilation: Callable[[], object]) -> None:
        if is_wanted():
            compilation()
        _stages[0] += 1

    _stages[:] = 0, len(compilations)
    try:
        with ThreadPoolExecutor(os.cpu_count()) as threads:
            list(threads.map(count, compilations))
    finally:
        _stages[:] = 0, 0


def compiling() -> str:
    """Say which stage is being compiled; "" where `compile_all` is not at work."""
    done, whole = _stages
    return f"compiling stage {min(done + 1, whole)} of {whole}, once" if whole else ""

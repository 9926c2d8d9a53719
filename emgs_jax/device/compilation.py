"""Compile programs in parallel before they are needed."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

from tqdm import tqdm


def compile_all(compilations: Sequence[Callable[[], object]], is_wanted: Callable[[], bool] = lambda: True) -> None:
    """Call functions that each compile a program, on all cores, with a progress bar.

    Args:
        is_wanted: called before each; False stops the rest.
    """
    bar = tqdm(total=len(compilations), desc="compiling, once", unit="stage", leave=False, disable=None)
    with ThreadPoolExecutor(os.cpu_count()) as threads, bar:
        for _ in threads.map(lambda compilation: compilation() if is_wanted() else None, compilations):
            bar.update()

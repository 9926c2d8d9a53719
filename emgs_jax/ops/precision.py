"""Matrix products in full float32 wherever they run."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def full_precision(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Decorate: the factors of matrix products inside are not rounded.

    By default JAX rounds them to ten bits (TF32) on recent GPUs, which is millimetres for a distant point. Every public
    function with such products asks for itself, so that importing the package changes nothing for other code.
    """

    @wraps(function)
    def precise(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with jax.default_matmul_precision("float32"):
            return function(*args, **kwargs)

    return precise

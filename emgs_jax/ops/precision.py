"""Matrix products in full float32 on every device."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def full_precision(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Decorate a function so that the factors of its matrix products are not rounded.

    By default JAX rounds them to ten bits (TF32) on recent GPUs, which means millimetres for a distant point. Every
    public function with such products has this decorator, so importing the package changes nothing for other code.
    """

    @wraps(function)
    def precise(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with jax.default_matmul_precision("float32"):
            return function(*args, **kwargs)

    return precise

"""What JAX says of its work inside a block."""

import contextlib

import jax.monitoring


@contextlib.contextmanager
def compiled():
    """Names of the functions that XLA makes executables of inside the block."""
    names = []

    def hear(event, _, **about):
        if event.endswith("backend_compile_duration"):
            names.append(about["fun_name"].removeprefix("jit_").removeprefix("jit(").removesuffix(")"))

    jax.monitoring.register_event_duration_secs_listener(hear)
    try:
        yield names
    finally:
        jax.monitoring.unregister_event_duration_listener(hear)

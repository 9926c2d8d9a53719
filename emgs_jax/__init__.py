"""MonoEM-GS as pure functions in JAX. README.md says what is where."""

try:
    import jax
except ImportError:  # recording predictions needs no JAX
    pass
else:
    # On recent GPUs JAX rounds the factors of matrix products to ten bits (TF32): millimetres for a distant point.
    if jax.config.jax_default_matmul_precision is None:
        jax.config.update("jax_default_matmul_precision", "float32")

"""Gaussian splatting in pure JAX: project (EWA), list splats by tile, composite front to back; `render` does all."""

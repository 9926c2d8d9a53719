"""Gaussian splatting in pure JAX: project (EWA), tiles (who is where), composite (front to back), one verb `render`."""

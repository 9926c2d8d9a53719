"""Open-set queries (Experiments C): every Gaussian gets the class whose text embedding is closest to its feature."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from emgs_jax.gaussians import Gaussians, has_feature
from emgs_jax.ops.linalg import safe_normalize
from emgs_jax.ops.precision import full_precision


@full_precision
def similarities(gaussians: Gaussians, text_features: Float[Array, "c f"]) -> Float[Array, "n c"]:
    """Cosine of every Gaussian's feature and every class's text embedding; 0 for a Gaussian without a feature."""
    return safe_normalize(gaussians.features) @ safe_normalize(text_features).T


@full_precision
def classify(gaussians: Gaussians, text_features: Float[Array, "c f"]) -> Int[Array, "n"]:
    """Class of every Gaussian; -1 for invalid rows and for Gaussians without a feature.

    Raises:
        ValueError: the embeddings' width differs from the map's, or there is no class.
    """
    if text_features.shape[0] == 0 or text_features.shape[1] != gaussians.features.shape[-1]:
        raise ValueError(
            f"text_features must be (classes, {gaussians.features.shape[-1]}) like the map's features, "
            f"got {tuple(text_features.shape)}: embed the classes with the model that made the map's features"
        )
    is_known = gaussians.valid & has_feature(gaussians.features)
    return jnp.where(is_known, jnp.argmax(similarities(gaussians, text_features), axis=-1), -1)

"""EWA projection: from a Gaussian in space to one on the image plane, whose inverse depth varies linearly."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from emgs_jax.gaussians import Gaussians
from emgs_jax.ops.camera import NEAREST_DEPTH, Camera, project
from emgs_jax.ops.linalg import inverse_2x2
from emgs_jax.ops.precision import full_precision

# At a grazing angle, no linear depth slope describes a splat.
SMALLEST_COSINE = 0.1
# Standard deviations of its depth by which a Gaussian must lie in front of the camera. If one reaches the camera's
# plane, as a door frame does in passing, the affine approximation turns it into a splat that hides everything.
NEAREST_STD = 2.0
# Points far outside the image have unbounded Jacobians, so the Jacobian is taken at most this far out,
FRUSTUM_MARGIN = 0.3  # of the image's size


class Splats(eqx.Module):
    """Gaussians on the image plane, row by row those of the map.

    The inverse depth at pixel p is `inverse_depth + depth_slope · (p - mean)`, exact for the plane through the
    Gaussian's mean with its normal.
    """

    means: Float[Array, "n 2"]  # pixels
    covs: Float[Array, "n 2 2"]  # pixels²
    precisions: Float[Array, "n 2 2"]  # 1/pixels²
    depth: Float[Array, "n"]  # camera-space z of the mean, m; 1 where it is not in front, for finite gradients
    depth_std: Float[Array, "n"]  # standard deviation of z over the Gaussian, m
    inverse_depth: Float[Array, "n"]  # 1/m
    depth_slope: Float[Array, "n 2"]  # 1/m per pixel
    valid: Bool[Array, "n"]  # in front of the camera, and seen from the side to which the normal points
    opacity: Float[Array, "n"]  # times that of the drawing, at its centre


@full_precision
def project_gaussians(
    gaussians: Gaussians, T_world_camera: jaxlie.SE3, camera: Camera, scale: Float[Array, ""], blur: Float[Array, ""]
) -> Splats:
    """Project Gaussians with the local affine approximation (Zwicker et al., "EWA splatting", 2002).

    A Gaussian whose normal points away from the camera is not drawn: a surface is seen only from the side it was mapped
    from. Otherwise the other side of a thin wall would show through where both are slightly off.

    Args:
        scale: by which the covariances are multiplied, so that neighbouring Gaussians close the surface.
        blur: pixels²; added to the image-plane covariance, the low-pass filter of EWA.
    """
    rotation = T_world_camera.rotation().as_matrix()
    points = (gaussians.means - T_world_camera.translation()) @ rotation
    covs = scale * jnp.einsum("ji,njk,kl->nil", rotation, gaussians.covs, rotation)
    normals = gaussians.normals @ rotation
    means, depth = project(camera, points)
    is_in_front = gaussians.valid & (depth > NEAREST_DEPTH)
    z = jnp.where(is_in_front, depth, 1.0)

    size = jnp.array([camera.width, camera.height], means.dtype)
    low, high = -FRUSTUM_MARGIN * size, (1.0 + FRUSTUM_MARGIN) * size
    tangent = (jnp.clip(means, low, high) - camera.center) / camera.focal
    focal_over_z = camera.focal / z[:, None]
    zero = jnp.zeros_like(z)
    jacobian = jnp.stack(
        [
            jnp.stack([focal_over_z[:, 0], zero, -focal_over_z[:, 0] * tangent[:, 0]], -1),
            jnp.stack([zero, focal_over_z[:, 1], -focal_over_z[:, 1] * tangent[:, 1]], -1),
        ],
        -2,
    )
    covs_2d = jnp.einsum("nai,nij,nbj->nab", jacobian, covs, jacobian) + blur * jnp.eye(2)

    depth_var = covs[:, 2, 2]
    depth_std = jnp.sqrt(jnp.where(depth_var > 0, depth_var, 1.0))
    # The plane n·X = n·μ meets the ray d = (x, y, 1) at 1/z = n·d / n·μ, linear in the pixel.
    facing = jnp.einsum("ni,ni->n", normals, points)
    limit = SMALLEST_COSINE * jnp.linalg.norm(jnp.where(is_in_front[:, None], points, 1.0), axis=-1)
    is_flat = jnp.abs(facing) > limit
    slope = normals[:, :2] / (camera.focal * jnp.where(is_flat, facing, 1.0)[:, None])
    return Splats(
        means=means,
        covs=covs_2d,
        precisions=inverse_2x2(covs_2d),
        depth=z,
        depth_std=depth_std,
        inverse_depth=1.0 / z,
        depth_slope=jnp.where((is_flat & is_in_front)[:, None], slope, 0.0),
        valid=is_in_front & (z > NEAREST_STD * depth_std) & (facing <= limit),
        opacity=jnp.ones_like(z),
    )

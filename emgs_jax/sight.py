"""What a frame shows where each Gaussian is: its surface, free space, or something before it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from emgs_jax.gaussians import Gaussians
from emgs_jax.ops.camera import NEAREST_DEPTH, Camera, nearest_pixel, project
from emgs_jax.ops.linalg import inner, lower_entries, quadratic

CLEAR = 2.0  # kσ of free space, which a surface does not open in one step when the depths of a network drift
BESIDE = 0.03  # of the width of an image, by which edges of a network, or of a pose, may be off


class Sight(NamedTuple):
    """What a frame shows where each Gaussian is.

    Args:
        index: its pixel.
        is_seen: whether the frame shows a surface there.
        is_seen_through: whether the frame shows free space there, up to a surface farther than kσ behind.
        reach: kσ (m).
        depth: of the Gaussian, z (m).
        variance: along its normal (m²).
    """

    index: Int[Array, "n"]
    is_seen: Bool[Array, "n"]
    is_seen_through: Bool[Array, "n"]
    reach: Float[Array, "n"]
    depth: Float[Array, "n"]
    variance: Float[Array, "n"]


def sight_of(
    gaussians: Gaussians,
    depths: Float[Array, "2 p"],
    T_world_camera: jaxlie.SE3,
    camera: Camera,
    depth_noise: Float[Array, ""],
    num_std: Float[Array, ""],
    min_cos: Float[Array, ""],
) -> Sight:
    """Compare each Gaussian with a frame.

    Args:
        depths: that the frame shows around each pixel, see `depth_range`.
        depth_noise: of its points, as a fraction of their depth.
        num_std: k.
        min_cos: between a normal and the ray; in a more grazing view a Gaussian is neither seen nor seen through.
    """
    rotation = T_world_camera.rotation().as_matrix()
    rays = gaussians.means - T_world_camera.translation()
    pixels, depth = project(camera, rays @ rotation)
    index, inside = nearest_pixel(pixels, (camera.height, camera.width))
    nearest, farthest = depths[:, index]
    variance = quadratic(lower_entries(gaussians.covs), jnp.unstack(gaussians.normals, axis=-1))
    reach = num_std * jnp.sqrt((depth_noise * depth) ** 2 + variance)
    is_steep = jnp.abs(inner(gaussians.normals, rays)) >= min_cos * jnp.linalg.norm(rays, axis=-1)
    is_looked_at = gaussians.valid & inside & (depth > NEAREST_DEPTH) & is_steep
    is_seen = is_looked_at & (jnp.minimum(jnp.abs(depth - nearest), jnp.abs(depth - farthest)) <= reach)
    is_seen_through = is_looked_at & (depth < nearest - reach)
    return Sight(index, is_seen, is_seen_through, reach, depth, variance)


def views_through(
    before: Float[Array, "n"], share: Float[Array, "n"], sight: Sight, depth: Float[Array, "p"], camera: Camera
) -> Float[Array, "n"]:
    """Count the views in a row that clearly see through each Gaussian, see `GaussianMap.num_through`.

    A look is clear if it shows free space farther than `CLEAR` kσ, and nothing as far away as the Gaussian within
    `BESIDE` of the image's width: the edge of a surface that a network or a pose puts aside is no free space. Where
    space opens in a smaller step the surface drifts, and no look counts until one sees it again.

    Args:
        share: of a view that this look is.
        depth: nearest that the look shows around each pixel.
    """
    gap = depth[sight.index] - sight.depth
    is_far = sight.is_seen_through & (gap > CLEAR * sight.reach)
    is_clear = is_far & ~_is_beside(depth, sight, camera) & (before >= 0)
    is_step = sight.is_seen_through & ~is_far & (before == 0)
    return jnp.where(sight.is_seen, 0.0, jnp.where(is_step, -1.0, before + share * is_clear))


def _is_beside(depth: Float[Array, "p"], sight: Sight, camera: Camera) -> Bool[Array, "n"]:
    """Test whether a look shows something as far away as each Gaussian, within kσ, beside its pixel."""
    image, ends = depth.reshape(camera.height, camera.width), (camera.height - 1, camera.width - 1)
    pixel = jnp.divmod(sight.index, camera.width)
    shifts = jnp.arange(-2, 3) * max(1, round(BESIDE * camera.width / 2))  # of depths over 3 × 3 pixels

    def look_beside(found: Bool[Array, "n"], shift: tuple) -> tuple[Bool[Array, "n"], None]:
        beside = image[tuple(jnp.clip(at + by, 0, end) for at, by, end in zip(pixel, shift, ends, strict=True))]
        return found | (jnp.abs(beside - sight.depth) <= sight.reach), None

    rows, columns = (shift.reshape(-1) for shift in jnp.meshgrid(shifts, shifts))
    return jax.lax.scan(look_beside, jnp.zeros(sight.depth.shape, bool), (rows, columns))[0]

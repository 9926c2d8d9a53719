"""Noise of the prior's poses, estimated from the difference between two predictions of the same pose.

In the previous prediction, today's current frame was the newest and today's previous frame the current one. So it has
the motion of the camera between the two, and the previous pose relative to the anchor. The current prediction has both
again. Depths tell less: a prior may repeat those of an image, and one that solves for poses knows poses better than
depths. Two predictions that are equal up to rounding are one prediction, of a prior that has one pose for a frame. Such
consistency is no evidence of accuracy, and the pose is as uncertain as without a repeated prediction.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from emgs_jax.observation import Prediction
from emgs_jax.ops.precision import full_precision
from emgs_jax.ops.pytree import stack
from emgs_jax.registration.rigid import pose_row, scale_translation

LOG_OF_SQUARE = -0.36898  # mean logarithm of χ²/3 with three degrees of freedom: ψ(3/2) - log(3/2)
LEAST_NOISE = 2e-4  # of the depth; keeps the covariance of an exact prior regular
NO_INFORMATION = 1e-6  # used instead of 0
SMALLEST_SQUARE = 1e-14  # in a logarithm
SAME_SQUARE = 1e-10  # by which a prediction may differ from itself: rounding, for lengths up to a hundred mean depths


class Repeats(eqx.Module):
    """Differences between repeated predictions so far; rows: motion to the next frame, pose relative to the anchor.

    Args:
        predicted: the last prediction of both, m of the map.
        is_predicted: False if they were not predicted; `predicted` is then the identity.
        log_squares: mean logarithm of the mean square difference per axis, of lengths in mean depths and of angles.
        counts: number of differences in that mean; an identical prediction does not count.
    """

    predicted: jaxlie.SE3
    is_predicted: Bool[Array, "*b 2"]
    log_squares: Float[Array, "*b 2 2"]
    counts: Float[Array, "*b 2"]


def no_repeats() -> Repeats:
    """Return the repeats of the frame that makes the map: none so far."""
    return Repeats(jaxlie.SE3.identity((2,)), jnp.zeros(2, bool), jnp.zeros((2, 2)), jnp.zeros(2))


def rescale_repeats(repeats: Repeats, factor: Float[Array, ""]) -> Repeats:
    """Return the repeats after all lengths of the map are multiplied by `factor`."""
    return eqx.tree_at(lambda r: r.predicted, repeats, scale_translation(repeats.predicted, factor))


@full_precision
def repeat_poses(
    prediction: Prediction,
    before: Repeats,
    scale: Float[Array, ""],
    mean_depth: Float[Array, ""],
    max_count: Float[Array, ""],
) -> tuple[Repeats, Float[Array, "2 2"]]:
    """Add the differences of this repeated prediction; also return their mean squares, 0 without new ones.

    Args:
        before: differences up to the last frame.
        scale: of this prediction. The returned poses are in its own unit; call `rescale_repeats` once the scale is
            final.
        mean_depth: of the previous frame, m of the map.
        max_count: number of differences from which on older ones are forgotten.
    """
    previous, current, newest = (pose_row(prediction.T_world_views, row) for row in range(3))
    anchor = prediction.T_world_anchor.inverse()
    again = scale_translation(stack([previous.inverse() @ current, anchor @ previous]), scale).wxyz_xyz
    is_again = before.is_predicted & jnp.all(jnp.isfinite(again), axis=-1) & prediction.is_repeat
    again = jnp.where(is_again[:, None], again, before.predicted.wxyz_xyz)
    units = jnp.stack([mean_depth, jnp.ones(())])[:, None]
    differences = (before.predicted.inverse() @ jaxlie.SE3(again)).log().reshape(2, 2, 3) / units
    squares = jnp.mean(differences**2, axis=-1)
    is_again = is_again & jnp.any(squares > SAME_SQUARE, axis=-1)
    squares = jnp.where(is_again[:, None], squares, 0.0)
    counts = jnp.minimum(before.counts + is_again, max_count)
    changes = (jnp.log(squares + SMALLEST_SQUARE) - before.log_squares) / jnp.maximum(counts, 1.0)[:, None]
    log_squares = before.log_squares + jnp.where(is_again[:, None], changes, 0.0)
    predicted = stack([current.inverse() @ newest, anchor @ current]).wxyz_xyz
    is_predicted = jnp.all(jnp.isfinite(predicted), axis=-1) & jnp.stack([prediction.has_newest, jnp.asarray(True)])
    predicted = jaxlie.SE3(jnp.where(is_predicted[:, None], predicted, jaxlie.SE3.identity().wxyz_xyz))
    return Repeats(predicted, is_predicted, log_squares, counts), squares


@full_precision
def pose_std(
    repeats: Repeats, latest: Float[Array, "2 2"], otherwise: Float[Array, ""], shared: Float[Array, ""]
) -> Float[Array, "2 2"]:
    """Estimate standard deviations per axis, of length and angle (columns), of the prior's motion and own pose (rows).

    Two predictions of variance v that share the part c of it differ by the variance 2 (1 - c) v. The mean is taken over
    logarithms, and the value expected without any repeat counts as one of them. So neither a turn on the spot nor a bad
    first guess dominates it. If a pose's own repeat differs by more, the pose is as uncertain as that.

    Args:
        latest: mean squares of this prediction alone, see `repeat_poses`.
        otherwise: standard deviations without any repeat, and for `shared` = 1.
        shared: c.
    """
    differing, counts = 2.0 * jnp.maximum(1.0 - shared, 1e-6), repeats.counts[:, None]
    of_repeats = repeats.log_squares - LOG_OF_SQUARE - jnp.log(differing)
    mean = (counts * of_repeats + 2.0 * jnp.log(otherwise)) / (counts + 1.0)
    found = jnp.sqrt(jnp.maximum(jnp.exp(mean), latest / differing))
    return jnp.where(shared < 1.0, found, otherwise)


def is_given_pose(prediction: Prediction) -> Bool[Array, ""]:
    """Tell whether the prior has a pose of the current frame and states its uncertainty."""
    pose = pose_row(prediction.T_world_views, 1).wxyz_xyz
    return jnp.all(jnp.isfinite(prediction.pose_covariance[1])) & jnp.all(jnp.isfinite(pose))


def pose_covariances(
    given: Float[Array, "2 6 6"],
    otherwise: Float[Array, "2 6"],
    mean_depth: Float[Array, ""],
    unit: Float[Array, ""],
) -> Float[Array, "2 6 6"]:
    """Compute covariances of the prior's motion and own pose, m and rad of the map.

    Stated covariances have a floor of `LEAST_NOISE` of the depth, which keeps them regular.

    Args:
        given: see `Prediction.pose_covariance`.
        otherwise: standard deviations of each axis, m of the map and rad, if none are stated.
        mean_depth: m of the map.
        unit: of the prediction's poses, m of the map.
    """
    units, lengths = (jnp.ones(6).at[:3].set(length) for length in (unit, mean_depth))
    is_given = jnp.all(jnp.isfinite(given), axis=(-2, -1), keepdims=True)
    given = units[:, None] * jnp.where(is_given, given, 0.0) * units + jnp.diag((LEAST_NOISE * lengths) ** 2)
    return jnp.where(is_given, given, jax.vmap(jnp.diag)(otherwise**2))


@full_precision
def axis_std(
    repeats: Repeats,
    latest: Float[Array, "2 2"],
    depth_noise: Float[Array, ""],
    mean_depth: Float[Array, ""],
    information: Float[Array, ""],
    shared: Float[Array, ""],
) -> Float[Array, "2 6"]:
    """Convert `pose_std` to m and rad for each axis, in the order of ξ.

    Args:
        latest: mean squares of this prediction alone.
        depth_noise: as a fraction of the depth.
        mean_depth: m of the map.
        information: of a pose without any repeat, in units of depths with this noise (`prior_information`).
        shared: see `pose_std`.
    """
    root = jnp.sqrt(jnp.maximum(information, NO_INFORMATION))
    std = jnp.maximum(pose_std(repeats, latest, depth_noise / root, shared), LEAST_NOISE / root)
    return jnp.repeat(std * jnp.append(mean_depth, 1.0), 3, axis=-1)

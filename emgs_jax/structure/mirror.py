"""The mirror image of a structure: short and nearly orthographic views fit it almost as well (Szeliski and Kang 1997).

An orthographic image cannot tell points from their mirror images in a plane parallel to it, seen from cameras that turn
the other way. Adjusted from both, perspective decides.
"""

import copy
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import numpy as np

from emgs_jax.geometry import nearest_rotation
from emgs_jax.structure.evidence import Evidence, explained
from emgs_jax.structure.library import load

NUM_TRIED = 8  # images with which the mirror image is tried
CLEAR = 0.01  # difference of the explained shares that decides


class Turned(NamedTuple):
    """What is kept of a model and its mirror image."""

    model: Any
    is_mirrored: bool
    is_doubtful: bool  # both explain the matches, and are different


def mirrored(model: Any) -> Any:
    """A copy: points through the plane at their depth that faces the mean camera, cameras that turn inversely."""
    pycolmap, model = load(), copy.deepcopy(model)
    images = [image for image in model.images.values() if image.has_pose]
    poses = [image.cam_from_world().matrix() for image in images]
    toward = mean_rotation(poses)
    flip = np.diag([1.0, 1.0, -1.0])
    in_world = toward.T @ flip @ toward
    center = center_of(model)
    for point in model.points3D.values():
        point.xyz = center + in_world @ (point.xyz - center)
    for image, pose in zip(images, poses, strict=True):
        R = flip @ pose[:, :3] @ in_world
        t = pose[:, :3] @ center + pose[:, 3] - R @ center  # the centre stays where each camera sees it
        # Two reflections make a rotation, seen from the camera's own axes.
        turned = pycolmap.Rigid3d(pycolmap.Rotation3d(R), t)
        model.frames[image.frame_id].set_cam_from_world(image.camera_id, turned)
    return model


def mean_rotation(poses: list[np.ndarray]) -> np.ndarray:
    """The rotation nearest to the mean of the poses' (3, 4)."""
    return nearest_rotation(np.sum([pose[:, :3] for pose in poses], axis=0))


def center_of(model: Any) -> np.ndarray:
    """The median of a model's points."""
    return np.median([point.xyz for point in model.points3D.values()], axis=0)


def turned_right(model: Any, evidence: Evidence, adjust: Callable[[Any], None]) -> Turned:
    """The model, or its mirror image where that explains more after `adjust`, which changes a model.

    A few of the images are tried first.
    """
    images = sorted(model.reg_image_ids())
    if len(model.points3D) < 3:
        return Turned(model, False, False)
    some = [images[row] for row in np.unique(np.linspace(0, len(images) - 1, NUM_TRIED).astype(int))]
    part = only(model, some)
    if len(part.points3D) < 3:  # images of a long walk share nothing
        return Turned(model, False, False)
    other = mirrored(part)
    adjust(other)
    gain = explained(other, evidence) - explained(part, evidence)
    if gain < -CLEAR or not is_reversed(other, part):  # or it turned back
        return Turned(model, False, False)
    whole = mirrored(model) if len(some) < len(images) else other
    if whole is not other:
        adjust(whole)
    gain = explained(whole, evidence) - explained(model, evidence)
    kept = Turned(whole, True, False) if gain > 0 else Turned(model, False, False)
    return kept._replace(is_doubtful=abs(gain) < CLEAR and is_reversed(whole, model))


def is_reversed(a: Any, b: Any) -> bool:
    """Test whether the relief of the points of both is near in one where it is far in the other."""
    common = sorted({*a.points3D} & {*b.points3D})
    if len(common) < 3:
        return True
    reliefs = []
    for model in (a, b):
        toward = mean_rotation([image.cam_from_world().matrix() for image in model.images.values() if image.has_pose])
        depth = np.array([toward[2] @ model.points3D[key].xyz for key in common])
        reliefs.append(np.argsort(np.argsort(depth)))
    return bool(np.corrcoef(*reliefs)[0, 1] < 0)


def only(model: Any, images: Collection[int]) -> Any:
    """A copy with these images alone, and the points that two or more of them show."""
    model = copy.deepcopy(model)
    observations = load().ObservationManager(model)
    for number in {*model.reg_image_ids()} - {*images}:
        observations.deregister_frame(model.images[number].frame_id)
    return model

"""What verified matches say of a model: the share of them that its poses explain, whatever points it has.

A match is explained if its epipolar error under the poses of its two images is small. Points and reprojection errors
tell less: a model that is wrong has points of its own, that fit.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from emgs_jax.structure.library import load

TIGHT = 1.0  # pixels up to which a match is explained: reversed and bent models differ from right ones by these
LOOSE = 4.0  # pixels up to which it does not contradict
MIN_SHARE = 0.5  # of the matches of an image, or of a pair, that do not contradict
MIN_MATCHES = 15  # of a pair that joins two images


class Evidence(NamedTuple):
    """Verified matches of a database, with their keypoints."""

    pairs: Sequence[tuple[int, int]]  # COLMAP's numbers of the images
    matches: Sequence[Int[np.ndarray, "m 2"]]  # rows of their keypoints
    own: Sequence[int]  # matches of each pair within TIGHT of a geometry of its own
    keypoints: dict[int, Float[np.ndarray, "k 2"]]
    pixel: float  # pixels of the images on disk in one of the images in which features are found

    @property
    def count(self) -> int:
        """All matches."""
        return sum(map(len, self.matches))


def read_evidence(database: Path, pixel: float) -> Evidence:
    """Read the verified matches of a database."""
    pycolmap = load()
    with pycolmap.Database.open(database) as opened:
        numbers, geometries = opened.read_two_view_geometries()
        keypoints = {
            image.image_id: np.asarray(opened.read_keypoints(image.image_id), float).reshape(
                opened.num_keypoints_for_image(image.image_id), -1
            )[:, :2]
            for image in opened.read_all_images()
        }
    found = [
        (pycolmap.pair_id_to_image_pair(number), np.asarray(geometry.inlier_matches, int), geometry.F)
        for number, geometry in zip(numbers, geometries, strict=True)
        if len(geometry.inlier_matches) >= MIN_MATCHES
    ]
    own = [
        count_own(F, keypoints[a][matches[:, 0]], keypoints[b][matches[:, 1]], pixel) for (a, b), matches, F in found
    ]
    return Evidence([tuple(pair) for pair, *_ in found], [matches for _, matches, _ in found], own, keypoints, pixel)


def count_own(F: Any, x: Float[np.ndarray, "m 2"], y: Float[np.ndarray, "m 2"], pixel: float) -> int:
    """Matches within TIGHT of a fundamental matrix, or of the one that fits all of them if there is none."""
    if F is None or not np.any(F):  # COLMAP has only the homography of a plane
        F, _ = cv2.findFundamentalMat(x, y, cv2.FM_8POINT)
    if F is None:
        return 0
    return int((sampson(F[:3], *(np.c_[xy, np.ones(len(xy))] for xy in (x, y))) < TIGHT * pixel).sum())


class Judged(NamedTuple):
    """The pairs of a model's images."""

    pairs: Int[np.ndarray, "p 2"]
    total: Int[np.ndarray, " p"]  # matches
    tight: Int[np.ndarray, " p"]  # of them within TIGHT
    loose: Int[np.ndarray, " p"]  # of them within LOOSE
    own: Int[np.ndarray, " p"]  # of them within TIGHT of the pair's own geometry


def judge(model: Any, evidence: Evidence) -> Judged:
    """Compare a model's poses with the matches of its images."""
    poses, rays = {}, {}
    for number in model.reg_image_ids():
        image = model.images[number]
        xy = np.asarray(image.camera.cam_from_img(evidence.keypoints[number]))
        poses[number], rays[number] = image.cam_from_world().matrix(), np.c_[xy, np.ones(len(xy))]
    focal = {number: model.images[number].camera.mean_focal_length() / evidence.pixel for number in poses}
    rows = []
    for (a, b), matches, own in zip(evidence.pairs, evidence.matches, evidence.own, strict=True):
        if a in poses and b in poses:
            error = focal[a] * epipolar_error(poses[a], poses[b], rays[a][matches[:, 0]], rays[b][matches[:, 1]])
            rows.append((a, b, len(matches), (error < TIGHT).sum(), (error < LOOSE).sum(), own))
    found = np.array(rows, int).reshape(-1, 6)
    return Judged(found[:, :2], *found[:, 2:].T)


def epipolar_error(
    a: Float[np.ndarray, "3 4"], b: Float[np.ndarray, "3 4"], x: Float[np.ndarray, "m 3"], y: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, " m"]:
    """Sampson's error of rays (u, v, 1), in focal lengths, for T_camera_world of both cameras."""
    R = b[:, :3] @ a[:, :3].T
    t = b[:, 3] - R @ a[:, 3]
    E = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ R
    return sampson(E, x, y)


def sampson(E: Float[np.ndarray, "3 3"], x: Float[np.ndarray, "m 3"], y: Float[np.ndarray, "m 3"]) -> np.ndarray:
    """Distance (m,) of matches y^T E x = 0 from it, in their unit, to first order."""
    lines_b, lines_a = x @ E.T, y @ E
    slope = np.sqrt((lines_a[:, :2] ** 2).sum(1) + (lines_b[:, :2] ** 2).sum(1))
    return np.abs((y * lines_b).sum(1)) / np.maximum(slope, 1e-12)


def share(models: Iterable[Any], evidence: Evidence) -> float:
    """The share of all matches that these models explain."""
    return sum(int(judge(model, evidence).tight.sum()) for model in models) / max(evidence.count, 1)


def explained(model: Any, evidence: Evidence) -> float:
    """The share of the matches of its images that a model explains."""
    judged = judge(model, evidence)
    return float(judged.tight.sum() / max(judged.total.sum(), 1))


def trust(models: Sequence[Any], evidence: Evidence, within: bool = False) -> float:
    """What models explain, of what pairs explain by themselves: all pairs, or those `within` the models."""
    judged = [judge(model, evidence) for model in models]
    possible = sum(int(one.own.sum()) for one in judged) if within else sum(evidence.own)
    return sum(int(one.tight.sum()) for one in judged) / max(possible, 1)


def contradicted(model: Any, evidence: Evidence) -> list[int]:
    """The images whose matches contradict their poses, the worst first, each beside those that remain."""
    judged, out = judge(model, evidence), []
    is_left = np.ones(len(judged.pairs), bool)
    while is_left.any():
        images, rows = np.unique(judged.pairs[is_left], return_inverse=True)
        agreeing, total = (
            np.bincount(rows.ravel(), np.repeat(values[is_left], 2)) for values in (judged.loose, judged.total)
        )
        worst = int(np.argmin(agreeing / total))
        if agreeing[worst] >= MIN_SHARE * total[worst]:
            break
        out.append(int(images[worst]))
        is_left &= (judged.pairs != images[worst]).all(axis=1)
    return out


def joined(model: Any, evidence: Evidence) -> list[list[int]]:
    """The images of a model in groups that agreeing pairs join, the largest first."""
    judged, images = judge(model, evidence), sorted(model.reg_image_ids())
    is_agreeing: Bool[np.ndarray, " p"] = (judged.loose >= MIN_SHARE * judged.total) & (judged.loose >= MIN_MATCHES)
    group = {image: image for image in images}

    def root(image: int) -> int:
        while group[image] != image:
            image = group[image]
        return image

    for a, b in judged.pairs[is_agreeing].tolist():
        group[root(a)] = root(b)
    roots = [root(image) for image in images]
    groups = [[image for image, its in zip(images, roots, strict=True) if its == one] for one in dict.fromkeys(roots)]
    return sorted(groups, key=len, reverse=True)

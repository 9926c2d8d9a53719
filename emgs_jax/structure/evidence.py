"""What verified matches say of a model: the share of them that its poses explain, whatever points it has.

A match is explained if its epipolar error under the poses of its two images is small. Points and reprojection errors
tell less: a model that is wrong has points of its own, that fit. Images near in time are believed to show the same
place; those far apart may show look-alikes. A wrong step along the direction of travel keeps the epipolar geometry, but
the two images then have no points in common: their pair is broken.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from emgs_jax.data.masks import stem
from emgs_jax.structure.library import load

TIGHT = 1.0  # pixels up to which a match is explained: reversed and bent models differ from right ones by these
LOOSE = 4.0  # pixels up to which it does not contradict
MIN_SHARE = 0.5  # of the matches of an image, or of a pair, that do not contradict
MIN_MATCHES = 15  # of a pair that counts
NEAR = 5  # images apart in time, up to which a pair is believed
BROKEN = 0.25  # share of a near pair's matches that are common points, below which it is broken; right ones have .4
APART = 0.1  # likewise, below which nothing joins its images: wrong steps have none, photos around a thing .2


class Evidence(NamedTuple):
    """Verified matches of a database, with their keypoints."""

    pairs: Sequence[tuple[int, int]]  # COLMAP's numbers of the images
    matches: Sequence[Int[np.ndarray, "m 2"]]  # rows of their keypoints
    own: Int[np.ndarray, " p"]  # matches of each pair within TIGHT of a geometry of its own
    is_near: Bool[np.ndarray, " p"]  # pairs of images near in time
    keypoints: dict[int, Float[np.ndarray, "k 2"]]
    pixel: float  # pixels of the images on disk in one of the images in which features are found

    @property
    def count(self) -> int:
        """All matches."""
        return sum(map(len, self.matches))


def read_evidence(database: Path, names: Sequence[str], pixel: float) -> Evidence:
    """Read the verified matches of a database; `names` of the images in order of time, without suffix."""
    pycolmap, row = load(), {name: number for number, name in enumerate(names)}
    with pycolmap.Database.open(database) as opened:
        numbers, geometries = opened.read_two_view_geometries()
        images = opened.read_all_images()
        keypoints = {image.image_id: _positions(opened, image.image_id) for image in images}
    time = {image.image_id: row[stem(image.name)] for image in images if stem(image.name) in row}
    found = [
        (pycolmap.pair_id_to_image_pair(number), np.asarray(geometry.inlier_matches, int), geometry.F)
        for number, geometry in zip(numbers, geometries, strict=True)
        if len(geometry.inlier_matches) >= MIN_MATCHES
    ]
    own = [
        count_own(F, keypoints[a][matches[:, 0]], keypoints[b][matches[:, 1]], pixel) for (a, b), matches, F in found
    ]
    pairs, matches = [tuple(pair) for pair, *_ in found], [matches for _, matches, _ in found]
    near = [a in time and b in time and abs(time[a] - time[b]) <= NEAR for a, b in pairs]
    return Evidence(pairs, matches, np.array(own, int), np.array(near, bool), keypoints, pixel)


def _positions(database: Any, image: int) -> Float[np.ndarray, "k 2"]:
    """Keypoints of an image."""
    count = database.num_keypoints_for_image(image)
    return np.asarray(database.read_keypoints(image), float)[:, :2] if count else np.zeros((0, 2))


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
    common: Int[np.ndarray, " p"]  # of them at common points; of near pairs only
    is_near: Bool[np.ndarray, " p"]

    @property
    def is_broken(self) -> Bool[np.ndarray, " p"]:
        """Near pairs whose images have hardly a point in common, though they match."""
        return self.is_near & (self.common < BROKEN * self.total)

    @property
    def is_apart(self) -> Bool[np.ndarray, " p"]:
        """Broken pairs that are surely wrong, whatever pairs far apart in time say."""
        return self.is_near & (self.common < APART * self.total)

    @property
    def counts(self) -> Bool[np.ndarray, " p"]:
        """Pairs that are believed: near ones, and all if there are none, as of photos."""
        return self.is_near if self.is_near.any() else np.ones_like(self.is_near)


def judge(model: Any, evidence: Evidence) -> Judged:
    """Compare a model's poses with the matches of its images."""
    poses, rays, points = {}, {}, {}
    for number in model.reg_image_ids():
        image = model.images[number]
        xy = np.asarray(image.camera.cam_from_img(evidence.keypoints[number]))
        poses[number], rays[number] = image.cam_from_world().matrix(), np.c_[xy, np.ones(len(xy))]
        points[number] = np.array([point.point3D_id if point.has_point3D() else -1 for point in image.points2D], int)
    focal = {number: model.images[number].camera.mean_focal_length() / evidence.pixel for number in poses}
    rows, counts = [], []
    for row, ((a, b), matches) in enumerate(zip(evidence.pairs, evidence.matches, strict=True)):
        if a in poses and b in poses:
            first, second = matches.T
            error = focal[a] * epipolar_error(poses[a], poses[b], rays[a][first], rays[b][second])
            is_common = (points[a][first] == points[b][second]) & (points[a][first] >= 0)
            rows.append(row)
            counts.append((a, b, len(matches), (error < TIGHT).sum(), (error < LOOSE).sum(), is_common.sum()))
    pairs, total, tight, loose, common = np.split(np.array(counts, int).reshape(-1, 6), [2, 3, 4, 5], axis=1)
    return Judged(
        pairs, total.ravel(), tight.ravel(), loose.ravel(), evidence.own[rows], common.ravel(), evidence.is_near[rows]
    )


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
    """What models explain, of what believed pairs explain by themselves: all, or those `within` the models.

    A broken pair explains nothing.
    """
    judged = [judge(model, evidence) for model in models]
    explains = sum(int(one.tight[one.counts & ~one.is_broken].sum()) for one in judged)
    believed = evidence.own[evidence.is_near] if evidence.is_near.any() else evidence.own
    possible = sum(int(one.own[one.counts].sum()) for one in judged) if within else int(believed.sum())
    return explains / max(possible, 1)


def contradicted(model: Any, evidence: Evidence) -> list[int]:
    """The images whose believed matches contradict their poses, the worst first, each beside those that remain."""
    judged, out = judge(model, evidence), []
    is_left = judged.counts.copy()
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
    """The images of a model in groups that agreeing pairs join, the largest first.

    Near pairs join first. Pairs far apart in time join two groups unless a near pair between them has no common points.
    """
    judged, images = judge(model, evidence), sorted(model.reg_image_ids())
    is_agreeing = (judged.loose >= MIN_SHARE * judged.total) & ~judged.is_broken
    group = {image: image for image in images}
    for a, b in judged.pairs[is_agreeing & judged.is_near].tolist():
        _join(group, group[a], group[b])
    for a, b in judged.pairs[is_agreeing & ~judged.is_near].tolist():
        between = {frozenset((group[c], group[d])) for c, d in judged.pairs[judged.is_apart].tolist()}
        if frozenset((group[a], group[b])) not in between:
            _join(group, group[a], group[b])
    groups = [[image for image in images if group[image] == one] for one in dict.fromkeys(group.values())]
    return sorted(groups, key=len, reverse=True)


def _join(group: dict[int, int], a: int, b: int) -> None:
    """Give the images of group `b` to group `a`."""
    for image, one in group.items():
        if one == b:
            group[image] = a

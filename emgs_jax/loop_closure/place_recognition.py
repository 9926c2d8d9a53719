"""Place recognition: keyframes, and loop candidates among them by the appearance of their images.

RootSIFT (Arandjelović and Zisserman, CVPR 2012) aggregated as VLAD (Jégou et al., CVPR 2010), with words trained on the
sequence's own descriptors. How similar two images of one place are depends on the scene, so a candidate is compared
with the keyframes just before the query, never with an absolute threshold.
"""

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from emgs_jax.keypoints import sift
from emgs_jax.ops.ranges import number

# Scale of a unit descriptor's entries as bytes; few exceed a half, and SIFT itself clips its own at .2.
BYTES_PER_UNIT = 512.0
BLOCK = 64  # queries that are compared with all keyframes at once


@dataclass(frozen=True)
class PlaceRecognitionConfig:
    """Description of keyframes and choice of candidates; gaps count frames.

    Args:
        num_features: keypoints of one image, at most.
        max_depth_step: between the depths of the four pixels around a keypoint, relative to the smallest; beyond it, an
            interpolated depth would lie on no surface.
        grid: columns and rows of the stored depths.
        max_training: descriptors used for training; no fewer than words.
        min_gap: between the query and a candidate.
        suppressed_gap: around a candidate, within which less similar ones are dropped.
        num_neighbours: keyframes before the query whose similarities to it give the threshold.
        quantile: of these similarities, which a candidate must reach.
    """

    num_features: int = number(500, low=1)
    min_contrast: float = number(0.003, low=0, high=1)  # pale walls have no more
    max_depth_step: float = number(0.05, low=0, high=math.inf)
    grid: tuple[int, int] = number((80, 60), low=1, high=4096)
    num_words: int = number(64, low=1, high=65536)
    max_training: int = number(10000, low=1, high=1e8)
    num_iterations: int = number(15, low=0, high=1000)
    seed: int = number(0, low=0, high=2**31 - 1)
    min_gap: int = number(60, low=0)
    suppressed_gap: int = number(25, low=0)
    num_candidates: int = number(5, low=1, high=1000)
    num_neighbours: int = number(8, low=1, high=1000)
    quantile: float = number(0.5, low=0, high=1)


@dataclass(frozen=True)
class Keyframe:
    """Description of an image for place recognition; about 95 kB with 500 keypoints and 80 by 60 depths.

    Args:
        pixels: of the keypoints, centres at integers.
        descriptors: RootSIFT as bytes; `unit_descriptors` decodes them.
        points: of the keypoints, camera frame, units of its own inference; NaN without depth.
        intrinsics: fx, fy, cx, cy in pixels.
        depths: z at the centres of the cells of a regular grid over the image, units of the inference; 0 without depth.
    """

    frame: int
    pixels: Float32[np.ndarray, "n 2"]
    descriptors: UInt8[np.ndarray, "n 128"]
    points: Float32[np.ndarray, "n 3"]
    intrinsics: tuple[float, float, float, float]
    size: tuple[int, int]
    depths: Float32[np.ndarray, "y x"]


@dataclass(frozen=True)
class Database:
    """Keyframes in order of time, each with a vector; products of vectors are cosines.

    Args:
        words: the vocabulary (k, 128); empty before the first keypoint.
        num_trained: keyframes that the words were trained on.
    """

    keyframes: tuple[Keyframe, ...] = ()
    words: Float32[np.ndarray, "k 128"] = field(default_factory=lambda: np.zeros((0, sift.DESCRIPTOR_SIZE), np.float32))
    vectors: Float32[np.ndarray, "n v"] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    num_trained: int = 0


def make_keyframe(
    frame: int,
    image: UInt8[np.ndarray, "h w 3"],
    points: Float32[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    intrinsics: Sequence[float],
    config: PlaceRecognitionConfig,
) -> Keyframe:
    """Make a keyframe from an RGB image and its prediction: camera-frame points where the mask is on.

    Raises:
        ValueError: image, points and mask differ in size.
    """
    if image.shape[:2] != points.shape[:2] or points.shape[:2] != mask.shape:
        raise ValueError(
            f"image {image.shape[:2]}, points {points.shape[:2]} and mask {mask.shape} must be of one height and width"
        )
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    pixels, descriptors = sift.detect(gray, config.num_features, config.min_contrast)
    # SIFT may give more than requested if the last ones are equally strong.
    pixels, descriptors = np.float32(pixels[: config.num_features]), descriptors[: config.num_features]
    as_bytes = np.uint8(np.clip(np.round(BYTES_PER_UNIT * descriptors), 0, 255))
    at_pixels = _interpolated(points, mask, pixels, config.max_depth_step)
    depths = sampled_depths(points, mask, config.grid)
    return Keyframe(frame, pixels, as_bytes, at_pixels, tuple(map(float, intrinsics)), mask.shape[::-1], depths)


def grid_pixels(size: tuple[int, int], grid: tuple[int, int]) -> tuple[Int[np.ndarray, " x"], Int[np.ndarray, " y"]]:
    """Find the pixels nearest to the centres of a grid's cells over an image of this width and height."""
    x, y = (np.int64((np.arange(cells) + 0.5) * pixels / cells) for cells, pixels in zip(grid, size, strict=True))
    return x, y


def sampled_depths(
    points: Float32[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], grid: tuple[int, int]
) -> Float32[np.ndarray, "y x"]:
    """Sample the depth of camera-frame points at the centres of a grid of cells; 0 where the mask is off."""
    x, y = grid_pixels(mask.shape[::-1], grid)
    return np.float32(np.where(mask, points[..., 2], 0.0)[np.ix_(y, x)])


def _interpolated(
    points: np.ndarray, mask: np.ndarray, pixels: Float32[np.ndarray, "n 2"], max_depth_step: float
) -> Float32[np.ndarray, "n 3"]:
    """Interpolate points (h, w, 3) at each keypoint; NaN if one of its four pixels has none or they lie apart."""
    corner = np.clip(np.int64(pixels), 0, np.array(mask.shape)[::-1] - 2)
    x, y = (corner[:, None] + np.array([(0, 0), (1, 0), (0, 1), (1, 1)])).transpose(2, 0, 1)
    around, is_known = np.float64(points[y, x]), mask[y, x].all(axis=1)
    right, down = (pixels - corner).T
    weights = np.stack([(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down], axis=1)
    nearest, farthest = around[..., 2].min(axis=1), around[..., 2].max(axis=1)
    is_known &= (nearest > 0) & (farthest - nearest <= max_depth_step * nearest)
    mean = np.einsum("nk,nkd->nd", weights, around)
    return np.float32(np.where(is_known[:, None], mean, np.nan))


def unit_descriptors(keyframe: Keyframe) -> Float32[np.ndarray, "n 128"]:
    """Decode the descriptors of a keyframe to unit length."""
    descriptors = np.float32(keyframe.descriptors)
    return descriptors / np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1.0)


def add_keyframe(database: Database, keyframe: Keyframe, config: PlaceRecognitionConfig) -> Database:
    """Add a keyframe to the database; words are retrained whenever the number of keyframes has doubled.

    Raises:
        ValueError: the keyframe is not later than the last.
    """
    if database.keyframes and keyframe.frame <= database.keyframes[-1].frame:
        raise ValueError(f"frame {keyframe.frame} must come after {database.keyframes[-1].frame}: extend in order")
    keyframes = (*database.keyframes, keyframe)
    if len(keyframes) < 2 * database.num_trained:
        vector = vlad(unit_descriptors(keyframe), database.words)
        return Database(keyframes, database.words, np.vstack([database.vectors, vector]), database.num_trained)
    return train_database(keyframes, config)


def with_keyframes(database: Database, keyframes: Sequence[Keyframe], config: PlaceRecognitionConfig) -> Database:
    """Add the keyframes of another run, in the order of their frames; words are retrained as by `add_keyframe`."""
    every = [*database.keyframes, *keyframes]
    order = np.argsort([one.frame for one in every], kind="stable")
    ordered = tuple(every[row] for row in order)
    if len(every) >= 2 * database.num_trained:
        return train_database(ordered, config)
    vectors = np.vstack([database.vectors, *(vlad(unit_descriptors(one), database.words) for one in keyframes)])
    return replace(database, keyframes=ordered, vectors=vectors[order])


def train_database(keyframes: Sequence[Keyframe], config: PlaceRecognitionConfig) -> Database:
    """Make a database of keyframes, in their order, with words trained on all of them."""
    sizes = config.num_words, config.max_training, config.num_iterations
    words = train_words(_evenly_chosen(keyframes, _num_chosen(sizes)), sizes, config.seed)
    vectors = np.stack([vlad(unit_descriptors(one), words) for one in keyframes])
    return Database(tuple(keyframes), words, vectors, len(keyframes) if len(words) else 0)


def _evenly_chosen(keyframes: Sequence[Keyframe], most: int) -> Float32[np.ndarray, "n 128"]:
    """Decode descriptors of all keyframes, evenly chosen, at most so many."""
    ends = np.cumsum([len(one.descriptors) for one in keyframes])
    parts = np.split(rows := _even_rows(ends[-1], most), np.searchsorted(rows, ends[:-1]))
    begins = [0, *ends[:-1]]
    chosen = [unit_descriptors(one)[part - at] for one, part, at in zip(keyframes, parts, begins, strict=True)]
    return np.concatenate(chosen)


def _even_rows(count: int, most: int) -> Int[np.ndarray, " r"]:
    return np.linspace(0, count - 1, min(count, most)).astype(int)


def _num_chosen(sizes: tuple[int, int, int]) -> int:
    return max(sizes[1], sizes[0])


def train_words(
    descriptors: Float32[np.ndarray, "n d"], sizes: tuple[int, int, int], seed: int
) -> Float32[np.ndarray, "k d"]:
    """Train words, the centres of k-means over evenly chosen descriptors; none if descriptors are fewer than words.

    Args:
        sizes: number of words, maximal number of descriptors, number of iterations.
    """
    num_words, _, num_iterations = sizes
    if len(descriptors) < num_words:
        return np.zeros((0, descriptors.shape[1]), np.float32)
    chosen = descriptors[_even_rows(len(descriptors), _num_chosen(sizes))]
    cv2.setRNGSeed(seed)
    stop = (cv2.TERM_CRITERIA_MAX_ITER, num_iterations, 0.0)
    return cv2.kmeans(chosen, num_words, None, stop, 1, cv2.KMEANS_PP_CENTERS)[2]


def vlad(descriptors: Float32[np.ndarray, "n 128"], words: Float32[np.ndarray, "k 128"]) -> Float32[np.ndarray, " v"]:
    """Compute VLAD: for each word the sum of its descriptors' differences from it, as one unit vector; 0 without any.

    Each word's part is normalised before the signed root, so that repeated texture does not outweigh the rest
    (Arandjelović and Zisserman, CVPR 2013).
    """
    parts = np.zeros_like(words)
    if len(words):
        word = (descriptors @ words.T - 0.5 * (words**2).sum(axis=1)).argmax(axis=1)
        np.add.at(parts, word, descriptors - words[word])
    parts = _unit(parts)
    return _unit((np.sign(parts) * np.sqrt(np.abs(parts))).ravel())


def _unit(vectors: Float32[np.ndarray, "*b d"]) -> Float32[np.ndarray, "*b d"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-6)


def propose_candidates(database: Database, row: int, config: PlaceRecognitionConfig) -> list[int]:
    """Propose loop candidates (rows): earlier keyframes at least as similar as the query's neighbours, best first.

    They are at least `min_gap` frames older. Within `suppressed_gap` frames only the best counts, and there are at most
    `num_candidates`. The threshold is a quantile of the similarity to neighbours (LoopSplat, ViSTA-SLAM).
    """
    (similarity,) = similarities(database, [row])
    return _proposed(similarity, _frames_of(database), row, config)


def propose_for_all(database: Database, rows: Sequence[int], config: PlaceRecognitionConfig) -> Iterator[list[int]]:
    """Yield what `propose_candidates` returns for each row, and read the vectors once for a block of rows."""
    frames = _frames_of(database)
    for begin in range(0, len(rows), BLOCK):
        block = rows[begin : begin + BLOCK]
        for row, similarity in zip(block, similarities(database, block), strict=True):
            yield _proposed(similarity, frames, row, config)


def similarities(database: Database, rows: Sequence[int]) -> Float32[np.ndarray, "r n"]:
    """Compute the similarity of some keyframes to all up to the last of them."""
    return database.vectors[[*rows]] @ database.vectors[: max(rows) + 1].T


def _frames_of(database: Database) -> Int[np.ndarray, " n"]:
    return np.array([keyframe.frame for keyframe in database.keyframes])


def _proposed(
    similarity: Float32[np.ndarray, " m"], frames: Int[np.ndarray, " n"], row: int, config: PlaceRecognitionConfig
) -> list[int]:
    similarity, frames = similarity[: row + 1], frames[: row + 1]
    neighbours = similarity[max(row - config.num_neighbours, 0) : row]
    if not len(neighbours):
        return []
    is_old = frames <= frames[row] - max(config.min_gap, 1)
    # An image without keypoints is similar to none, not even itself.
    is_alike = (similarity >= np.quantile(neighbours, config.quantile)) & (similarity > 0)
    return _apart(similarity, frames, is_old & is_alike, config.num_candidates, config.suppressed_gap)


def most_similar(
    database: Database, query: Keyframe, rows: Sequence[int], count: int, config: PlaceRecognitionConfig
) -> list[int]:
    """Find the keyframes (rows) most similar to a query without a known time, one within each `suppressed_gap` frames.

    There is no threshold, because that of `propose_candidates` comes from the query's neighbours in time.
    """
    similarity = database.vectors @ vlad(unit_descriptors(query), database.words)
    frames = _frames_of(database)
    is_allowed = np.zeros(len(frames), bool)
    is_allowed[list(rows)] = True
    return _apart(similarity, frames, is_allowed & (similarity > 0), count, config.suppressed_gap)


def _apart(
    similarity: Float32[np.ndarray, " n"],
    frames: Int[np.ndarray, " n"],
    is_allowed: Bool[np.ndarray, " n"],
    count: int,
    gap: int,
) -> list[int]:
    """Choose the most similar allowed rows, at most `count`, each more than `gap` frames from better ones."""
    chosen: list[int] = []
    left = np.where(is_allowed, similarity, -np.inf)
    while len(chosen) < min(count, len(left)) and left[best := int(np.argmax(left))] > -np.inf:
        chosen.append(best)
        left[np.abs(frames - frames[best]) <= gap] = -np.inf
    return chosen


def keyframes_but(database: Database, nodes: Collection[int]) -> Database:
    """Remove the keyframes of some nodes."""
    rows = [row for row, one in enumerate(database.keyframes) if one.frame not in nodes]
    return replace(database, keyframes=tuple(database.keyframes[row] for row in rows), vectors=database.vectors[rows])

"""Windows of two visits of a place in a recording, found from images and recorded depths."""

import contextlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from emgs_jax.data.base import Dataset
from emgs_jax.loop_closure.place_recognition import (
    Database,
    PlaceRecognitionConfig,
    add_keyframe,
    make_keyframe,
    propose_candidates,
)
from emgs_jax.loop_closure.two_view_alignment import AlignmentConfig, RefusedError, align
from emgs_jax.prior.base import Prior, Window, calls_of, visits, with_frames
from emgs_jax.prior.recorded import Recorded, add_visits, visits_file


def places_seen_twice(
    replay: Recorded,
    dataset: Dataset,
    window_size: int,
    appearance: PlaceRecognitionConfig,
    alignment: AlignmentConfig,
    progress: Callable[[Sequence[Window]], Iterable[Window]] = iter,
) -> list[tuple[int, int]]:
    """Find pairs of frames, the earlier first, of similar appearance whose keypoints fit one motion of the camera.

    A run detects loop candidates likewise. If it has other keyframes (a saved map, frames lost at first,
    `slam.initialization=merged`), it may find others, which are not recorded.
    """
    database, pairs, seen = Database(), [], set()
    calls = list(calls_of(replay, dataset, window_size))
    for window, frames in with_frames(progress(calls), dataset):
        prediction = replay.predict(window, list(frames.values()), dataset.intrinsics)
        for row, index in enumerate(window.dense):
            if index in seen:
                continue
            seen.add(index)
            image, points, mask = frames[index].image, prediction.points[row], prediction.mask[row]
            query = make_keyframe(index, image, points, mask, dataset.intrinsics, appearance)
            database = add_keyframe(database, query, appearance)
            for candidate in propose_candidates(database, len(database.keyframes) - 1, appearance):
                earlier = database.keyframes[candidate]
                with contextlib.suppress(RefusedError):
                    align(earlier, query, alignment)
                    pairs.append((earlier.frame, index))
    return pairs


def record_visits(
    prior: Prior,
    dataset: Dataset,
    window_size: int,
    folder: Path | str,
    pairs: Sequence[tuple[int, int]],
    spacing: int,
    progress: Callable[[Sequence[tuple[int, int]]], Iterable[tuple[int, int]]] = iter,
) -> int:
    """Add the prior's predictions of both visits of each pair to a complete recording; return how many it holds."""
    replay, known = Recorded(folder), 0
    for a, b in progress(pairs):
        window = visits(a, b, spacing, window_size)
        if not replay.has_whole(visits_file(window)):
            found = prior.revisit(window, [dataset[index] for index in window.views], dataset.intrinsics)
            if found is None:
                continue
            add_visits(Path(folder), found)
        known += 1
    return known

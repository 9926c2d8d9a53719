"""A data set without unreadable frames."""

import contextlib
import hashlib
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from emgs_jax.data.base import BadFrameError, Dataset, Frame, Rates
from emgs_jax.data.masks import MANY, Masks, check_names, files_of, masked, stem
from emgs_jax.data.reading import is_turned_unseen, read_bytes
from emgs_jax.data.spool import Spool

MAX_KEPT_BYTES = 2**30  # of cached frames, uncompressed; others are read again
ARRAYS = ("image", "depth", "labels", "moving", "mask")  # of a frame
MAX_STEP_M = 100.0  # between consecutive frames in use; beyond, they show nothing in common


class ReadableFrames:
    """The frames of a data set that a run uses, themselves a `Dataset`, cached in a temporary file.

    Args:
        on_bad_frame: `error`: an unreadable frame ends the run in its turn, an unreadable true pose at once; `skip`:
            all frames are read here, and unreadable ones are left out.
        progress: wraps the frame numbers of that pass, e.g. tqdm.
        masks: of the frames; masked pixels have no truth either.

    Attributes:
        kept: index in `dataset` of each frame in use.
        skipped: index in `dataset` and reason of the others.
    """

    def __init__(
        self,
        dataset: Dataset,
        on_bad_frame: str = "error",
        progress: Callable[[Iterable[int]], Iterable[int]] = iter,
        masks: Masks = Masks(),  # noqa: B008 (it is frozen)
    ) -> None:
        if on_bad_frame not in ("error", "skip"):
            raise ValueError(f"on_bad_frame must be error or skip, got {on_bad_frame!r}")
        self._dataset = dataset
        self._spool, self._places = Spool(), {}  # frames without arrays, and the arrays' positions
        for name in ("name", "sequence", "size", "intrinsics", "calibration", "classes", "has_ground_truth"):
            setattr(self, name, getattr(dataset, name))
        self.all_names = getattr(dataset, "all_names", ())
        self.full_intrinsics = getattr(dataset, "full_intrinsics", None)
        self._grows, indices = dataset.total is None, range(len(dataset))
        if self._grows and masks.folder is not None:
            raise ValueError(f"masks.folder={masks.folder} cannot have masks of images that are still to come")
        may_skip = on_bad_frame == "skip"
        self._masks, self._mask_files = masks, files_of_masks(dataset, masks, may_skip)
        self.has_masks = any(self._mask_files)
        self.skipped = _unreadable(self._read, progress(indices)) if may_skip else {}
        self.kept = [index for index in indices if index not in self.skipped]
        if not self.kept:
            what = f"{dataset.name} {dataset.sequence}"
            first = next(iter(self.skipped.values()), "there are none")
            raise ValueError(f"{what} has no frame that can be read: {first}")
        if may_skip and masks.folder is not None:
            masks.files(*([every[index] for index in self.kept] for every in files_of(dataset)))
        _check_truth(dataset, self.kept)
        self.mask_note = self._mask_note() if self.has_masks else None

    def __len__(self) -> int:
        return len(self.kept)

    def has(self, index: int) -> bool:
        """Test whether there is a frame `index`; waits for it while more may come."""
        num_known = len(self.kept) + len(self.skipped)  # of the data set's
        while index >= len(self.kept) and self._grows and self._dataset.has(num_known):
            self.kept.append(num_known)
            num_known += 1
        return index < len(self.kept)

    def drop_last(self) -> None:
        """Leave out the last frame that has come, as if it had not."""
        self._places.pop(self.kept.pop(), None)
        self._dataset.drop_last()

    @property
    def total(self) -> int | None:
        """Number of frames; None while more may come."""
        return None if self._grows and self._dataset.total is None else len(self)

    def begin(self) -> None:
        """Be told that mapping begins now."""
        if self._grows:
            self._places.clear()
        self._dataset.begin()

    def progress_words(self, index: int) -> str:
        """Return words for the progress bar after frame `index` is mapped."""
        return self._dataset.progress_words(self.kept[index])

    @property
    def rates(self) -> Rates | None:
        """How the last frame was mapped; None where images do not pass."""
        return self._dataset.rates

    def report(self) -> dict[str, float]:
        """Return statistics of how the frames came, as keys `camera/…`."""
        return self._dataset.report()

    def recording(self) -> Mapping[str, Any] | None:
        """Return settings that read the same frames again; None if they are those of this data set, or none do."""
        return self._dataset.recording()

    def __getitem__(self, index: int) -> Frame:
        return replace(self._read(self.kept[index]), index=index)

    def _read(self, index: int) -> Frame:
        if index in self._places:
            frame, places = self._places[index]
            return replace(frame, **{name: self._spool[place] for name, place in places.items()})
        frame = self._dataset[index]
        is_out = self._left_out(index, self.size)
        if is_out is not None:
            frame = masked(frame, is_out)
        self._keep(index, frame)
        return frame

    def _keep(self, index: int, frame: Frame) -> None:
        arrays = {name: getattr(frame, name) for name in ARRAYS if getattr(frame, name) is not None}
        if self._spool.num_bytes + sum(array.nbytes for array in arrays.values()) <= MAX_KEPT_BYTES:
            with contextlib.suppress(OSError):  # a full disk keeps nothing, and is no failure
                places = {name: self._spool.append(array) for name, array in arrays.items()}
                self._places[index] = replace(frame, **dict.fromkeys(ARRAYS)), places

    def full(self, index: int) -> np.ndarray:
        """The image at its size on disk, not cached."""
        return self[index].image if self.full_intrinsics is None else self._dataset.full(self.kept[index])

    def full_mask(self, index: int) -> np.ndarray | None:
        """What is left out of `full`, bool (h, w); None without a mask."""
        return self._left_out(self.kept[index], self.size if self.full_intrinsics is None else self._dataset.raw_size)

    def stored_pixels(self, index: int) -> np.ndarray | None:
        return self._dataset.stored_pixels(self.kept[index])

    @property
    def raw_size(self) -> tuple[int, int]:
        return self._dataset.raw_size

    def pixel_of(self, index: int, pixel: np.ndarray) -> np.ndarray:
        """The column and row, in frame `index`, of a pixel of its image on disk."""
        return self._dataset.pixel_of(self.kept[index], pixel)

    def _mask_note(self) -> str:
        """Say of how many frames there are masks, and how much some of these leave out."""
        own = [index for index in self.kept if self._mask_files[index] is not None]
        share = np.mean([self._left_out(index, self.size).mean() for index in own[:: len(own) // 5 + 1]])
        note = f"masks of {len(own)} of {len(self.kept)} frames leave out {100 * share:.0f} % of the images"
        if share > MANY:
            note += "; black is left out, white is kept: invert yours if they are white where something is left out"
        images = [self._mask_files[index][1] for index in own if getattr(self._dataset, "is_turned", True)]
        turned = next((image for image in images if image and is_turned_unseen(image)), None)
        if turned is not None:
            note += (
                f"; {turned.name} is shown turned by its EXIF in a way that the sides of a mask do not tell: masks are "
                "taken as of the image as it is shown; turn those of the stored pixels"
            )
        return note

    def _left_out(self, index: int, size: tuple[int, int]) -> np.ndarray | None:
        """What the mask of the data set's frame leaves out of its image in this (width, height)."""
        if index >= len(self._mask_files) or self._mask_files[index] is None:
            return None
        mask, image = self._mask_files[index]
        turned = image if getattr(self._dataset, "is_turned", True) else None
        is_out = self._masks.decoded(mask, self._dataset.raw_size, turned)
        return self._masks.fitted(self._dataset.straight(index, is_out), size)

    def pose(self, index: int) -> np.ndarray | None:
        return self._dataset.pose(self.kept[index])

    def number(self, index: int) -> int:
        return getattr(self._dataset, "number", int)(self.kept[index])

    def files(self, index: int) -> Sequence[Path]:
        return self._dataset.files(self.kept[index])

    def fingerprint(self) -> str:
        """The data set's fingerprint, unless frames are left out."""
        whole = self._dataset.fingerprint()
        if self.has_masks:
            whole = fingerprint_with_masks(whole, self._mask_files, self._masks.border)
        return hashlib.sha256(repr((whole, tuple(self.kept))).encode()).hexdigest() if self.skipped else whole


MaskFile = tuple[Path, Path | None]  # a mask and the file of its image


def files_of_masks(dataset: Dataset, masks: Masks, may_lack: bool) -> list[MaskFile | None]:
    """The mask of each frame of the data set, in the folder or its own; None where it has none."""
    if masks.folder is None:
        own = getattr(dataset, "mask_file", lambda _: None)
        found = [own(index) for index in range(len(dataset))]
        return [path and (path, dataset.files(index)[0]) for index, path in enumerate(found)]
    images, numbers = files_of(dataset)
    found = masks.files(images, numbers, may_lack)
    check_names(dataset, {stem(path.name) for path in masks.paths}, f"masks.folder={masks.folder}")
    return [path and (path, image) for path, image in zip(found, images, strict=True)]


def fingerprint_with_masks(whole: str, files: Sequence[MaskFile | None], border: int) -> str:
    """The fingerprint of frames and of their masks' contents; `whole` is that of the frames alone."""
    masks = [hashlib.sha256(read_bytes(found[0])).hexdigest() for found in files if found]
    return hashlib.sha256(repr((whole, masks, border)).encode()).hexdigest()


def _unreadable(read: Callable[[int], Frame], indices: Iterable[int]) -> dict[int, str]:
    """Indices of unreadable frames, with the reasons."""
    reasons = {}
    for index in indices:
        try:
            read(index)
        except BadFrameError as error:
            reasons[index] = str(error)
    return reasons


def _check_truth(dataset: Dataset, kept: Sequence[int]) -> None:
    """Raise BadFrameError if a true pose is damaged or far from the one before, ValueError if there is none."""
    poses = [dataset.pose(index) for index in kept]  # before the first frame is read
    if not dataset.has_ground_truth:  # poses may have another unit
        return
    if all(pose is None for pose in poses):
        raise ValueError(
            f"{dataset.name} {dataset.sequence}: 0 of {len(kept)} images have a true pose: fetch the trajectory again, "
            "or choose other images (dataset.start, stop, stride)"
        )
    known = [(row, pose[:3, 3]) for row, pose in enumerate(poses) if pose is not None]
    for (index, place), (other, next_place) in itertools.pairwise(known):
        step = float(np.linalg.norm(next_place - place))
        if step > MAX_STEP_M * (other - index):
            raise BadFrameError(
                f"{dataset.name} {dataset.sequence}: the true pose of frame {kept[other]} is {step:.0f} m from that of "
                f"frame {kept[index]}, and a walk has no step of more than {MAX_STEP_M:g} m: correct the trajectory, "
                "or write nan where the pose is not known"
            )

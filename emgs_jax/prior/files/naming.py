"""Match predictions with frames by the names of files."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from emgs_jax.data.base import Dataset
from emgs_jax.data.file_names import check_numbering, frame_name


def rows_of(
    dataset: Dataset, names: Sequence[str], folder: Path, may_lack: bool = False, remedy: str = "predict it"
) -> list[int | None]:
    """Row of every frame among the predictions' `names`: by image name, apart from a common ending, else by order.

    Where a video has more predictions than frames in use, their names are the numbers of its frames, from 0 on.
    With `may_lack` a frame without a prediction gets None; else ValueError, with `remedy`.
    """
    files = [dataset.files(index)[:1] for index in range(len(dataset))]
    stems = [file[0].stem if file else "" for file in files]
    rows, ends = {name: row for row, name in enumerate(names)}, {""}
    has_names = len({*filter(None, stems)}) == len(stems)
    if has_names:
        ends |= {end for name in names if (end := name.removeprefix(stems[0])) != name and end and not end[0].isalnum()}
    counts = {end: sum(stem + end in rows for stem in stems) for end in sorted(ends)}
    best = [end for end in counts if counts[end] == max(counts.values())]
    best = [""] if "" in best else best  # names as they are say most
    if not has_names or not counts[best[0]]:
        if len(names) != len(stems):
            numbered = {name.zfill(6): row for name, row in rows.items()}
            own = [*map(frame_name, map(getattr(dataset, "number", int), range(len(stems))))]
            if not has_names and {frame_name(0), *own} <= numbered.keys():
                return [numbered[name] for name in own]
            raise ValueError(
                f"{folder} has {len(names)} predictions ({names[0]} ...) and the data set {len(stems)} frames "
                f"({stems[0] or 'without names'} ...), and their names do not tell which is whose: name the files as "
                "the images, or choose the frames that were predicted (dataset.start, stop, stride)"
            )
        return [*range(len(stems))]
    if len(best) > 1:
        raise ValueError(f"{folder} has files of several kinds for each frame, *{', *'.join(best)}: leave one kind")
    found = [stem + best[0] for stem in stems]
    check_numbering([f"{name}{best[0]}" for name in getattr(dataset, "all_names", ())], found, names, folder)
    if twice := [name for name, count in Counter(names).items() if count > 1 and name in found]:
        raise ValueError(
            f"{folder} has several predictions of the name {twice[0]}, of which one is of the frame: give images and "
            "predictions of one folder, or names of which each is there once"
        )
    missing = [name for name in found if name not in rows]
    if missing and not may_lack:
        raise ValueError(
            f"{folder} has no file for {len(missing)} of {len(stems)} frames, the first is {missing[0]}: {remedy}, or "
            "leave the frame out (dataset.start, stop, stride)"
        )
    return [rows.get(name) for name in found]

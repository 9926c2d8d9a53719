"""nerfstudio's transforms.json as it is read: camera → world with OpenGL's axes, pixels from the image's corner."""

import json
from pathlib import Path

import numpy as np

from emgs_jax.ops.axes import FLIP


def load_transforms(path: Path) -> tuple[list[str], list[list[float]]]:
    """File and camera → world with OpenCV's axes, 16 numbers row by row, of every frame of a transforms.json.

    Raises:
        ValueError: the file is no such file, or has no frames; the message names what is wrong with it.
    """
    try:
        frames = json.loads(path.read_text(encoding="utf-8-sig", errors="replace"))["frames"]
        names = [frame["file_path"] for frame in frames]
        matrices = [np.array(frame["transform_matrix"], np.float64) for frame in frames]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(
            f"{path} must hold frames with file_path and transform_matrix, and it does not ({error!r}): export it again"
        ) from error
    if not names:
        raise ValueError(f"{path} has no frames: export it again")
    for name, matrix in zip(names, matrices, strict=True):
        if not isinstance(name, str) or matrix.shape not in ((3, 4), (4, 4)):
            raise ValueError(f"{path}: frame {name!r} must have a transform_matrix of 4 rows of 4: export it again")
    bottom = [[0.0, 0.0, 0.0, 1.0]]
    return names, [((m if len(m) == 4 else np.vstack([m, bottom])) * FLIP).ravel().tolist() for m in matrices]

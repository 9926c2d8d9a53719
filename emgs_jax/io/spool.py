"""Arrays that do not fit into memory together: written to a temporary file as they come, read back one by one."""

import tempfile

import numpy as np


class Spool:
    """A sequence of arrays that grows at its end; the file has no name and goes with the object."""

    def __init__(self) -> None:
        self._file, self._begins = tempfile.TemporaryFile(), []  # noqa: SIM115 (open as long as this object)

    def append(self, array: np.ndarray) -> None:
        """Add an array."""
        self._begins.append(self._file.seek(0, 2))
        np.save(self._file, array, allow_pickle=False)

    def __len__(self) -> int:
        return len(self._begins)

    def __getitem__(self, index: int) -> np.ndarray:
        self._file.seek(self._begins[index])
        return np.load(self._file, allow_pickle=False)

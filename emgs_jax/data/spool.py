"""Arrays that do not fit into memory together: written to a temporary file as they come, read back one by one."""

import tempfile
import threading

import numpy as np


class Spool:
    """A sequence of arrays that grows at its end, for any thread; the file has no name and goes with the object."""

    def __init__(self) -> None:
        self._file, self._begins = tempfile.TemporaryFile(), []  # noqa: SIM115 (open as long as this object)
        self._lock, self.num_bytes = threading.Lock(), 0

    def append(self, array: np.ndarray) -> int:
        """Add an array; returns its position."""
        with self._lock:
            begin = self._file.seek(0, 2)
            np.save(self._file, array, allow_pickle=False)
            self.num_bytes = self._file.tell()
            self._begins.append(begin)
            return len(self._begins) - 1

    def __len__(self) -> int:
        return len(self._begins)

    def __getitem__(self, index: int) -> np.ndarray:
        with self._lock:
            self._file.seek(self._begins[index])
            return np.load(self._file, allow_pickle=False)

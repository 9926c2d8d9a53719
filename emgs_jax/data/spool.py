"""A sequence of arrays in a temporary file, for data that does not fit into memory."""

import tempfile
import threading

import numpy as np


class Spool:
    """A thread-safe sequence of arrays in a file that is deleted with the object.

    The file holds plain bytes: before Python 3.11.8 two threads that parse headers of `numpy.save` raise SystemError.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 (open as long as this object)
        self._places: list[tuple[int, tuple[int, ...], np.dtype]] = []  # offset, shape and type of each array
        self._lock, self.num_bytes = threading.Lock(), 0

    def append(self, array: np.ndarray) -> int:
        """Add an array; returns its position."""
        with self._lock:
            begin = self._file.seek(0, 2)
            self._file.write(_bytes(np.asarray(array, order="C")))
            self.num_bytes = self._file.tell()
            self._places.append((begin, array.shape, array.dtype))
            return len(self._places) - 1

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> np.ndarray:
        with self._lock:
            begin, shape, dtype = self._places[index]
            array = np.empty(shape, dtype)
            self._file.seek(begin)
            self._file.readinto(_bytes(array))
            return array


def _bytes(array: np.ndarray) -> np.ndarray:
    return array.reshape(-1).view(np.uint8)

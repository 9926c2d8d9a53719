"""Oracles: NumPy's own reader, and files whose headers lie."""

import io
import json
import warnings
import zipfile

import numpy as np
import pytest

from emgs_jax.io.npz import read_npz

ARRAYS = {
    "a": np.arange(12.0).reshape(3, 4),
    "b": np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
    "empty": np.zeros((0, 3), np.float16),
    "scalar": np.asarray(True),
    "text": np.array(json.dumps({"é": 1})),
}


def saved(save=np.savez, **arrays) -> bytes:
    buffer = io.BytesIO()
    save(buffer, **arrays)
    return buffer.getvalue()


def test_what_numpy_writes_is_read_bit_for_bit_and_may_be_changed():
    found = read_npz(saved(**ARRAYS))
    assert list(found) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape)
        assert found[name].tobytes() == array.tobytes() and found[name].flags.writeable
    assert list(read_npz(saved(**ARRAYS), ("b",))) == ["b"]
    packed = saved(np.savez_compressed, a=np.arange(1000.0))
    np.testing.assert_array_equal(read_npz(packed, may_be_compressed=True)["a"], np.arange(1000.0))
    with pytest.raises(ValueError, match="it lacks c, d"):
        read_npz(saved(**ARRAYS), ("a", "c", "d"))


def member(shape: str, data: bytes, descr: str = "<f8") -> bytes:
    """An .npz with the array `a` whose header says what it likes; the checksum fits."""
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    content = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("a.npy", content)
    return buffer.getvalue()


def twice() -> bytes:
    buffer = io.BytesIO(member("(2,)", b"\0" * 16))
    with zipfile.ZipFile(buffer, "a") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of zipfile, which notices
        archive.writestr("a.npy", b"")
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (twice(), "two arrays of one name"),
        (member("(30064771072,)", b"\0" * 16), "announces float64 .* is 240518168576 bytes, and holds 16"),
        (member("(1,)", b"\0" * 16), "is 8 bytes, and holds 16"),
        (member("(-2, -1)", b"\0" * 16), "announces float64"),
        (member("(2,)", b"\0" * 16, "|O"), "Object arrays cannot be loaded"),
        (member("(2,)", b"\0" * 16, "nonsense"), "descr"),
        (saved(np.savez_compressed, a=np.zeros(4)), "is compressed"),
        (b"no zip", "BadZipFile"),
        (saved(a=np.zeros(4))[:-30], "BadZipFile"),
    ],
)
def test_a_file_that_says_more_than_it_holds_is_refused(content, message):
    with pytest.raises(ValueError, match=message):
        read_npz(content)

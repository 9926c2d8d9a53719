"""Files that torch.save wrote, now and before version 1.6: the tensors in them, and nothing that is not one."""

import io
import os
import pickle
import zipfile

import numpy as np
import pytest

from emgs_jax.io.torch_tensors import MAGIC, read_tensors


def saved(value, tmp_path, is_archive=False):
    torch = pytest.importorskip("torch", reason="torch is not installed")
    torch.save(value, tmp_path / "file.pth", _use_new_zipfile_serialization=is_archive)
    return (tmp_path / "file.pth").read_bytes()


@pytest.mark.parametrize("is_archive", [False, True])
def test_tensors_are_what_torch_wrote(is_archive, tmp_path):
    torch = pytest.importorskip("torch", reason="torch is not installed")
    whole = torch.arange(24.0).reshape(2, 3, 4)
    tensors = {"whole": whole, "part": whole[1, 1:], "number": torch.tensor(7), "empty": torch.zeros(0, 3)}
    content = saved(
        {"epoch": 3, "model": tensors, "optimizer": {"state": [{"step": 0.5}], "groups": ()}}, tmp_path, is_archive
    )
    found = read_tensors(content, "model")
    assert found.keys() == tensors.keys()
    for name, tensor in tensors.items():
        np.testing.assert_array_equal(found[name], tensor.numpy())
    assert read_tensors(saved(torch.nn.Linear(2, 1).state_dict(), tmp_path, is_archive), None).keys() == {
        "weight",
        "bias",
    }
    with pytest.raises(ValueError, match="damaged"):
        read_tensors(content, "weights")
    with pytest.raises(ValueError, match="no plain array"):
        read_tensors(saved({"model": {"turned": whole.transpose(0, 1)}}, tmp_path, is_archive), "model")


class Command:
    def __reduce__(self):
        return os.mkdir, ("made",)


@pytest.mark.parametrize("is_archive", [False, True])
@pytest.mark.parametrize("value", [Command(), {"model": Command()}, {"model": {"weight": Command()}}])
def test_what_a_file_would_run_is_refused(value, is_archive, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stream = io.BytesIO()
    if is_archive:
        with zipfile.ZipFile(stream, "w") as archive:
            archive.writestr("file/data.pkl", pickle.dumps(value, protocol=2))
    else:
        for part in (MAGIC, 1001, {}, value, []):
            pickle.dump(part, stream, protocol=2)
    with pytest.raises(ValueError, match="more than tensors"):
        read_tensors(stream.getvalue(), "model")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("is_archive", [False, True])
def test_a_file_that_is_cut_or_another_is_refused(is_archive, tmp_path):
    torch = pytest.importorskip("torch", reason="torch is not installed")
    content = saved({"model": {"a": torch.arange(6.0), "b": torch.arange(4)}}, tmp_path, is_archive)
    for length in range(0, len(content) - 1, 3):
        with pytest.raises(ValueError):
            read_tensors(content[:length], "model")
    with pytest.raises(ValueError):
        read_tensors(b"PK\x03\x04" + bytes(100), "model")


def test_a_storage_that_no_memory_holds_is_damage(tmp_path):
    """It was an OverflowError."""
    torch, stream = pytest.importorskip("torch", reason="torch is not installed"), io.BytesIO()
    whole = zipfile.ZipFile(io.BytesIO(saved({"a": torch.zeros(2, 3)}, tmp_path, is_archive=True)))
    with zipfile.ZipFile(stream, "w") as archive:
        for name in whole.namelist():
            six, huge = b"cpuq\x06K\x06t", b"cpuq\x06\x8a\x09" + (2**70).to_bytes(9, "little") + b"t"
            archive.writestr(name, whole.read(name).replace(six, huge))
    with pytest.raises(ValueError, match="damaged .OverflowError"):
        read_tensors(stream.getvalue(), None)

"""Optional packages, and PyTorch's companions that were compiled for another version of it."""

import importlib
import importlib.util
import sys
from importlib.metadata import PackageNotFoundError, version
from types import ModuleType

REMEDIES = {
    "torchaudio": "nothing here uses it: pip uninstall torchaudio",
    "torchvision": "pip install --force-reinstall torch torchvision, both from the package index that torch is from",
}


def extra(module: str, words: str, name: str) -> ModuleType:
    """Import a module of the extra `name`; ValueError, which begins with `words`, if it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ValueError(f'{words}: pip install "emgs_jax[{name}]"') from error


def companion_problem() -> str | None:
    """Name the installed companion of PyTorch that cannot be imported, the reason and the remedy; None if all can.

    Other packages import a companion that they find, and report its failure as their own.
    """
    for name, remedy in REMEDIES.items():
        if importlib.util.find_spec(name) is None:
            continue
        try:
            importlib.import_module(name)
        except Exception as error:  # a missing library, a missing operator, another CUDA
            return f"{name} {_version(name)} does not fit torch {_version('torch')} ({first_line(error)}): {remedy}"
    return None


def best_device(torch: ModuleType, what: str, key: str) -> str:
    """Return "cuda" if there is a GPU, else "cpu", and warn that `what` is slow there; `key`=cpu would ask for it."""
    if torch.cuda.is_available():
        return "cuda"
    print(
        f"warning: torch {torch.__version__} finds no GPU, so {what} runs on the CPU, which is slow "
        f"({key}=cpu silences this)",
        file=sys.stderr,
    )
    return "cpu"


def first_line(error: BaseException) -> str:
    """The first line of an error's message, or its type: some of PyTorch's messages are pages long."""
    lines = str(error).strip().splitlines()
    return lines[0].strip()[:300] if lines else type(error).__name__


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "(of unknown version)"

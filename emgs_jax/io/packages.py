"""Packages that need not be there, and those that are compiled for another version of PyTorch."""

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
    """Import a module that one of the extras of this package brings.

    Args:
        words: what needs it, for the message.

    Raises:
        ValueError: it is not installed; the message says how it would be.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ValueError(f'{words}: pip install "emgs_jax[{name}]"') from error


def companion_problem() -> str | None:
    """Say which companion of PyTorch is installed but cannot be imported, why, and the remedy; None where all is well.

    Others import them when they find them, and then report what they could not import themselves.
    """
    for name, remedy in REMEDIES.items():
        if importlib.util.find_spec(name) is None:
            continue
        try:
            importlib.import_module(name)
        except Exception as error:  # a library that is missing, an operator that is missing, another CUDA
            return f"{name} {_version(name)} does not fit torch {_version('torch')} ({first_line(error)}): {remedy}"
    return None


def best_device(torch: ModuleType, what: str, key: str) -> str:
    """A GPU if there is one; a CPU, which nobody asked for, is mentioned.

    Args:
        what: runs there, for the message.
        key: of the config that would ask for it.
    """
    if torch.cuda.is_available():
        return "cuda"
    print(
        f"warning: torch {torch.__version__} finds no GPU, so {what} runs on the CPU, which is slow "
        f"({key}=cpu says that this is meant)",
        file=sys.stderr,
    )
    return "cpu"


def first_line(error: BaseException) -> str:
    """The first line of what an error says, or its type: some of PyTorch's go on for pages."""
    lines = str(error).strip().splitlines()
    return lines[0].strip()[:300] if lines else type(error).__name__


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "(of unknown version)"

"""pycolmap within a program: not installed, its words in a config, and signals."""

import subprocess
import sys

import pytest

from emgs_jax.structure.library import load, member


def test_without_pycolmap_it_is_said_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ValueError, match="pycolmap, which is not installed .*prior=files"):
        load()


def test_who_listens_to_sigterm_still_does_after_pycolmap_was_loaded():
    """Symptom: the import took the signal for itself: a run was not ended in order, but by a stack of C++."""
    script = (
        "import os, signal; from emgs_jax.structure.library import load\n"
        "signal.signal(signal.SIGTERM, lambda *_: print('heard'))\n"
        "load(); os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "heard\n", "")


def test_names_are_pycolmaps_in_any_case():
    assert member("FeatureExtractorType", "Sift", "features") == load().FeatureExtractorType.SIFT

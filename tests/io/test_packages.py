"""Which package broke is found by importing it; files that fail as the real ones do stand in for them."""

import sys

import pytest

from emgs_jax.io.packages import REMEDIES, companion_problem, first_line


@pytest.fixture
def site(tmp_path, monkeypatch):
    for name in [*sys.modules]:
        if name.partition(".")[0] in REMEDIES:
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(tmp_path)
    for name in REMEDIES:
        (tmp_path / f"{name}.py").write_text("")
    yield tmp_path
    for name in REMEDIES:
        sys.modules.pop(name, None)


@pytest.mark.parametrize(
    ("name", "error", "said", "remedy"),
    [
        ("torchvision", 'RuntimeError("operator nms does not exist")', "operator nms", "--force-reinstall torch torch"),
        ("torchaudio", 'OSError("libcudart.so.13: none\\nmore")', "libcudart.so.13: none", "pip uninstall torchaudio"),
    ],
)
def test_a_package_of_another_torch_is_named_with_the_cause_and_the_remedy(site, name, error, said, remedy):
    assert companion_problem() is None
    sys.modules.pop(name)
    (site / f"{name}.py").write_text(f"raise {error}\n")
    problem = companion_problem()
    assert problem.startswith(f"{name} ") and remedy in problem and said in problem and "more" not in problem


def test_the_first_line_of_an_error_or_its_type():
    assert first_line(RuntimeError("\n  Error(s) in loading:\n\tsize mismatch\n")) == "Error(s) in loading:"
    assert first_line(AssertionError()) == "AssertionError"
    assert len(first_line(ValueError("x" * 5000))) == 300

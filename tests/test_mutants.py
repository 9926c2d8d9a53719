"""What `python -m tools.mutants` tries is a bug of the code as it is, and each sample the same for all."""

import ast

import pytest

from tools.mutants.choose import ROOT, by_hand, compiles, is_core, nearest_tests, sample
from tools.mutants.operators import changed, edits

pytestmark = pytest.mark.slow

LINES = {  # each line, and all that a generator makes of it
    "x = a < len(b)": ["x = a <= len(b)"],
    "x = a < b": ["x = a >= b"],
    "x = a is not b": ["x = a is b"],
    "x = a - b * c": ["x = a + b * c", "x = a - b / c"],
    "x = a or b": ["x = a and b"],
    "x = valid & near": ["x = (valid)", "x = (near)"],
    "x = T @ U": ["x = (U) @ (T)"],
    "x = not a": ["x = (a)"],
    "x = [a for a in b if c]": ["x = [a for a in b if True]"],
    "f(0, 3, True)": ["pass", "f(1, 3, True)", "f(0, 6, True)", "f(0, 3, False)"],
    "x = a[1:, :n, 0]": ["x = a[(1) + 1:, :n, 0]", "x = a[1:, :(n) - 1, 0]", "x = a[1:, :n, 1]"],
    "x = jnp.minimum(a, b)": ["x = jnp.maximum(a, b)"],
    "x = jnp.where(a, b, c)": ["x = jnp.where(a, c, b)"],
    "x = jnp.zeros_like(a[0])": ["x = jnp.ones_like(a[0])"],
    "x = jnp.stack(a, axis=-1)": ["x = jnp.stack(a, axis=0)"],
    "x = jnp.sum(a, where=valid)": ["x = jnp.sum(a)"],
    "x = T.inverse()": ["x = (T)"],
    "x = a.at[i].set(b)": ["x = a.at[i].add(b)"],
    "def f():\n    return a, b": ["def f():\n    return b, a"],
    "def f(a):\n    a = g(a)": ["def f(a):\n    pass"],
    "def f(a):\n    if b:\n        return": ["def f(a):\n    pass"],
}
KEPT = [
    '__all__ = ["a", 1]',
    'def f(a: Float[Array, "3"]) -> Literal[3]:\n    """Three: 3 + 3."""',
    "if TYPE_CHECKING:\n    x = 1",
    'raise ValueError(f"{3 * 3} of {3}")',
    'print("ä", 3 - 1)',
    'x = "a" + b',
    "x = folder / name",
    "x: int = static(high=64)",
]


@pytest.mark.parametrize("line", LINES)
def test_the_operators_change_one_place_each(line):
    assert sorted(changed(line, edit) for edit in edits(line)) == sorted(LINES[line])


@pytest.mark.parametrize("line", KEPT)
def test_words_types_and_what_decides_no_result_stay(line):
    assert not list(edits(line))


def test_a_place_is_counted_in_bytes():
    source = 'y = "Größe"; x = a + b'
    assert [changed(source, edit) for edit in edits(source)] == ['y = "Größe"; x = a - b']


def test_a_changed_source_is_not_changed_elsewhere():
    (edit,) = edits("x = a + b")
    with pytest.raises(ValueError, match="line 1 is not what it was"):
        changed("xx = a + b", edit)


def test_a_sample_is_the_same_each_time_half_of_the_core_and_of_code_that_compiles():
    mutants = sample(60, seed=0)
    again = sample(60, seed=0)
    assert mutants == again != sample(60, seed=1)
    assert len(mutants) == 60 == len({(one.file, one.edit.line) for one in mutants})
    assert sum(is_core(one.file) for one in mutants) == 30
    for one in mutants:
        source = (ROOT / one.file).read_text()
        mutated = changed(source, one.edit)
        assert len(mutated) - len(source) == len(one.edit.after) - len(one.edit.before)
        assert ast.dump(ast.parse(mutated)) != ast.dump(ast.parse(source)), one


def test_each_mutant_that_was_made_by_hand_changes_the_code_and_has_tests():
    for one in by_hand():  # which refuses a text that does not occur exactly once
        assert compiles(one), one
        assert nearest_tests(one.file, reach=2), one


def test_a_file_meets_its_own_tests_first_and_then_those_that_import_it():
    found = nearest_tests("emgs_jax/ops/linalg.py", reach=1)
    assert found[0] == "tests/ops/test_linalg.py"
    assert "tests/registration/test_problem.py" in found
    assert set(found) < set(nearest_tests("emgs_jax/ops/linalg.py", reach=2))


def test_a_class_of_which_an_option_of_conf_makes_something_meets_the_tests_that_choose_the_option():
    found = nearest_tests("emgs_jax/prior/multiview/prior.py", reach=2)
    assert "tests/prior/multiview/test_learned.py" in found
    assert "tests/data/test_replica.py" not in found

"""The bugs of tools/by_hand.py are up to date; `python -m tools.by_hand` tries them."""

from tools.by_hand import bugs


def test_a_bug_made_by_hand_has_one_place_and_a_file_of_tests():
    found = {words: file.read_text(encoding="utf-8").count(before) for words, file, _, before, _ in bugs()}
    assert {*found.values()} == {1}, found
    assert all(tests.is_file() for _, _, tests, *_ in bugs())

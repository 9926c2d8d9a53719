"""Numbers as text; oracles: written by hand."""

import pytest

from emgs_jax.report.columns import DASH, MAIN, PLACED, RENDERED, cell, markdown


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((0.0321, None, 100.0, 2), "3.21"),
        ((0.0321, 0.004, 100.0, 2), "3.21 ± 0.40"),
        ((88.26, 1.25, 1.0, 1), "88.3 ± 1.2"),
        ((-0.5, None, 1.0, 1, "+"), "-0.5"),
        ((0.5, None, 1.0, 1, "+"), "+0.5"),
        ((None, 0.1, 1.0, 1), DASH),
        ((float("nan"), None, 1.0, 1), DASH),
        ((0.0, 0.0, 1.0, 1), "0.0 ± 0.0"),
    ],
)
def test_a_cell_is_mean_and_spread_in_one_unit(arguments, text):
    assert cell(*arguments) == text


def test_metres_are_shown_in_centimetres_and_less_of_them_is_better_and_the_rest_as_it_is():
    units = {"m": "[cm]", "percent": "[%]", "db": "[dB]"}
    for column in (*MAIN, *PLACED, *RENDERED):
        is_length = column.key.endswith("_m")
        assert (column.factor, column.is_lower_better) == ((100.0, True) if is_length else (1.0, False)), column.key
        assert column.title.endswith(units[column.key.rpartition("_")[2]])


def test_no_two_columns_of_a_table_have_one_title():
    titles = [column.title for column in (*MAIN, *PLACED, *RENDERED)]
    assert len(set(titles)) == len(titles)


def test_a_table_is_markdown():
    assert markdown(["a", "b"], [["1", "2"], ["3", "4"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |\n| 3 | 4 |\n"

"""Numbers as text; oracles: written by hand."""

import pytest

from emgs_jax.report.columns import (
    DASH,
    MAIN,
    PLACED,
    RENDERED,
    SHARE,
    Cell,
    Line,
    Table,
    aligned,
    cell,
    known,
    markdown,
    metric_table,
    transposed,
)


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


def test_the_share_of_placed_frames_stands_beside_the_error_where_one_is_missing():
    columns, row = (MAIN[0], SHARE, MAIN[1]), {MAIN[0].key: 0.1, MAIN[1].key: 0.1}
    assert known(columns, [row | {SHARE.key: 100.0}, row]) == [MAIN[0], MAIN[1]]
    assert known(columns, [row | {SHARE.key: 100.0}, row | {SHARE.key: 97.5}]) == [*columns]


def test_no_two_columns_of_a_table_have_one_title():
    titles = [column.title for column in (*MAIN, *PLACED, *RENDERED)]
    assert len(set(titles)) == len(titles)


def test_a_table_is_markdown_or_aligned_text_and_the_best_of_several_rivals_is_marked():
    column = MAIN[0]._replace(title="e", digits=0)
    lines = [
        Line([name], {column.key: value}, rivals=rivals)
        for name, value, rivals in (("a", 0.02, 0), ("bcd", 0.1, 0), ("e", None, 0), ("f", 0.01, 1), ("g", 0.01, None))
    ]
    values = [line.values for line in lines]
    assert known([*MAIN[1:], column], values) == [column] and known([column], values[2:3]) == []
    table = metric_table([""], [column], lines, ["tum"])
    assert [line[1] for line in table.lines] == [Cell("2", "best"), Cell("10"), Cell(DASH), Cell("1"), Cell("1")]
    table = table._replace(lines=table.lines[:2])
    assert markdown(table) == "|  | e |\n| --- | --- |\n| a | **2** |\n| bcd | 10 |\n"
    assert aligned(table) == "      e\n───────\na     2\nbcd  10"
    lengths = [(("tum",), "cm"), (("colmap",), ".01 units"), (("colmap", "tum"), "cm or .01 units")]
    assert [metric_table([], MAIN[:1], [], data).titles for data, _ in lengths] == [[f"ATE [{x}]"] for _, x in lengths]
    assert transposed(table) == Table(["", "a", "bcd"], [("e", Cell("2", "best"), Cell("10"))])

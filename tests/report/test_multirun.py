"""The table of many runs; oracles: the words and numbers of runs that are made up."""

import csv
from pathlib import Path

from written_run import written_run

from emgs_jax.report.columns import cell_text
from emgs_jax.report.multirun import read_multirun, table_of
from experiments.report import tabulate

ATE = "trajectory/ate_sim3_m"
NOISE = "slam.em.noise"


def ended(folder: Path, number: int, *words: str, **metrics: float) -> None:
    """A run that Hydra has made: its metrics, and the words that it was told."""
    run = written_run(folder / str(number), **metrics)
    (run / ".hydra").mkdir()
    (run / ".hydra" / "overrides.yaml").write_text("".join(f"- {word}\n" for word in words))


def test_the_table_has_a_column_for_each_key_that_differs_and_the_runs_in_their_order(tmp_path, capsys):
    for number, (noise, ate) in enumerate([("0", 0.03), ("inf", 0.01), ("0.5", 0.02)], 9):
        words = ["experiment=smoke", f"{NOISE}={noise}", *["slam/em=paper"] * (number == 10)]
        ended(tmp_path, number, *words, **{ATE: ate})
    keys, rows = read_multirun(tmp_path)
    assert keys == [NOISE, "slam/em"] and [row["run"] for row in rows] == ["9", "10", "11"]
    table = table_of(keys, rows)
    shown = [[cell_text(cell) for cell in line[:4]] for line in table.lines]
    assert [*table.titles[:3], table.titles[3]] == ["run", NOISE, "slam/em", "ATE [cm]"]
    assert shown == [["9", "0", "", "3.00"], ["10", "inf", "paper", "1.00"], ["11", "0.5", "", "2.00"]]
    assert [line[3].kind for line in table.lines] == ["", "best", ""]
    tabulate(tmp_path)
    assert "0.5" in capsys.readouterr().out and "| **1.00** |" in (tmp_path / "runs.md").read_text()
    with (tmp_path / "runs.csv").open() as file:
        found = list(csv.DictReader(file))
    assert [float(row[ATE]) for row in found] == [0.03, 0.01, 0.02] and found[1]["slam/em"] == "paper"

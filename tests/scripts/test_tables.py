"""The tables of the pages from made-up runs: numbers worked out by hand, and nothing else on a page changes."""

import json
import re
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from tiny_run import CONF

import experiments.evaluate
import tools.tables
from emgs_jax.io.files import write_json
from emgs_jax.runs.provenance import RAW_PRIOR, RESULT_FORMAT, prefixed
from emgs_jax.runs.results import METRICS_FILE
from tools.tables import COLUMNS, CONFIG, SHORT, block, short_block, tables

PAGE = "before\n<!-- table: some -->\nold\n<!-- end -->\nbetween\n<!-- table: other -->\n<!-- end -->\nafter\n"
ONE_COMMIT = {"revision": "0123456789abcdef", "dirty": False}


def written(folder: Path, seed: int, git: dict | None = ONE_COMMIT, ours: float = 0.02, raw: float = 0.03) -> Path:
    """A result of the built-in room: every length is `ours` metres, every other number 100 times that."""
    values = {column.key: 1.0 if column.factor == 100.0 else 100.0 for column in COLUMNS}
    metrics = {key: ours * unit for key, unit in values.items()}
    metrics |= prefixed({key: raw * unit for key, unit in values.items()}, RAW_PRIOR)
    block = {"format": RESULT_FORMAT, "protocol": "paper/sim3", "simulated": True, "git": git, "seed": seed}
    block |= {"prior": {"name": "simulated"}, "device": {"kind": "cpu", "cpu_count": 2}, "config": {}}
    block["data"] = {"name": "synthetic", "sequence": "room0"}
    path = folder / str(seed) / METRICS_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, metrics | {"trajectory/num_frames": 40, "time/seconds_per_frame": 0.5, "provenance": block})
    return path


def cells(line: str) -> list[str]:
    return [text.strip() for text in line.strip().strip("|").split("|")]


def test_rows_are_mean_and_deviation_over_the_seeds_and_the_map_is_counted_against_the_prior(tmp_path):
    """Ours 2 and 4 (mean 3, deviation √2), the prior 3 and 3: of two runs each metric is better in one."""
    folder = tmp_path / "default"
    paths = [written(folder, 3, ours=0.02), written(folder, 4, ours=0.04)]
    text = block(paths, {"synthetic": "room"})
    rows = [cells(line) for line in text.splitlines() if line.startswith("| room")]
    assert rows == [
        ["room", "ours", "2", *["3.0 ± 1.4"] * len(COLUMNS)],
        ["room", "raw prior", "2", *["3.0 ± 0.0"] * len(COLUMNS)],
    ]
    counts = next(line for line in text.splitlines() if line.startswith("Runs of 2"))
    assert counts.count(" 1,") + counts.count(" 1.") == len(COLUMNS)


def test_the_short_table_has_what_is_named_and_the_best_of_each_column_in_bold(tmp_path):
    """Lengths of ours are the smaller ones, and so are its shares, which is worse."""
    paths = [written(tmp_path / "default", 3, ours=0.02, raw=0.03), written(tmp_path / "level 2", 3, ours=0.01)]
    text = short_block(
        paths, {"synthetic": "room"}, {"data": ["synthetic"], "settings": ["default"], "kinds": ["ours", "raw prior"]}
    )
    rows = [cells(line) for line in text.splitlines() if line.startswith("| room")]
    lower = [column.is_lower_better for column in SHORT]
    assert any(lower) and not all(lower)
    assert rows == [
        ["room", "ours", "1", *["**2.0**" if is_lower else "2.0" for is_lower in lower]],
        ["room", "raw prior", "1", *["3.0" if is_lower else "**3.0**" for is_lower in lower]],
    ]
    alone = short_block(
        paths, {"synthetic": "room"}, {"data": ["synthetic"], "settings": ["level 2"], "kinds": ["ours"]}
    )
    assert [cells(line)[0] for line in alone.splitlines() if "ours" in line] == ["room, level 2"]


@pytest.mark.parametrize(
    "other", [{"revision": "f" * 16, "dirty": False}, ONE_COMMIT | {"dirty": True}, ONE_COMMIT | {"dirty": None}, None]
)
def test_results_of_other_or_changed_code_are_refused(tmp_path, other):
    with pytest.raises(ValueError, match="of one commit without changes"):
        block([written(tmp_path, 3), written(tmp_path, 4, other)], {"synthetic": "room"})


@pytest.fixture
def settings(tmp_path):
    """tools/tables.yaml with the built-in room alone."""
    pages = {"page": tmp_path / "page.md", "full_page": tmp_path / "full.md"}
    for page in pages.values():
        page.write_text(PAGE)
    config = OmegaConf.to_container(OmegaConf.load(CONFIG), resolve=False)
    config["short"]["data"] = ["synthetic"]
    settings = {"default": {}, "level 2": {"prior.level": 2}}
    own = {"root": "nowhere", "out": str(tmp_path / "out")} | {key: str(page) for key, page in pages.items()}
    return config | own | {"tables": {"some": [{"data": ["synthetic"], "seeds": [3, 4], "settings": settings}]}}


@pytest.mark.slow
def test_what_is_finished_is_not_run_again_and_the_page_is_written_when_all_is_there(settings, monkeypatch):
    runs, page = [], Path(settings["page"])

    def run(config, folder):
        runs.append((config.prior.level, config.prior.seed))
        if config.prior.level == 2 and len(runs) == 3:
            raise OSError("the disk is full")
        path = written(folder.parent, config.prior.seed)
        metrics = json.loads(path.read_text())
        metrics["provenance"]["config"] = OmegaConf.to_container(config, resolve=True)
        write_json(path, metrics)

    monkeypatch.setattr(experiments.evaluate, "run", run)
    monkeypatch.setattr(tools.tables, "git_now", lambda: ONE_COMMIT | {"dirty": True})
    with pytest.raises(ValueError, match="of one commit without changes"):
        tables(settings)
    assert not runs
    monkeypatch.setattr(tools.tables, "git_now", lambda: ONE_COMMIT)
    with pytest.raises(ValueError, match="the disk is full"):
        tables(settings)
    assert page.read_text() == PAGE
    tables(settings)
    assert runs == [(1.0, 3), (1.0, 4), (2.0, 3), (2.0, 4), (2.0, 3)]
    text, full = page.read_text(), Path(settings["full_page"]).read_text()
    assert "Runs of 2" in full and "(default):" in full and "(level 2):" in full and "old" not in full
    assert "| room | ours |" in text and "level 2" not in text and "Runs of" not in text and "old" not in text
    # What is there can be written again by other code, which did not make it.
    monkeypatch.setattr(tools.tables, "git_now", lambda: None)
    tables(settings)
    assert len(runs) == 5 and (page.read_text(), Path(settings["full_page"]).read_text()) == (text, full)


def test_both_pages_have_the_places_of_all_tables_every_row_has_a_title_and_both_are_of_one_commit():
    config, about = OmegaConf.load(CONFIG), []
    for key in ("page", "full_page"):
        text = (CONF.parent / config[key]).read_text()
        assert all(text.count(f"<!-- table: {name} -->") == 1 for name in config.tables)
        assert text.count("<!-- end -->") == len(config.tables)
        about.append(re.findall(r"^Prior [^|]*?; commit `\w+`\.$", text, re.MULTILINE))
    assert {data for rows in config.tables.values() for row in rows for data in row.data} <= set(config.titles)
    assert about[0] == about[1] and len(about[0]) == len(config.tables)

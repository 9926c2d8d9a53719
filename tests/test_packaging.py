"""What is installed: every folder of code, conf/ and experiments/ below the package, and nothing else at the top."""

import tomllib
from pathlib import Path

import pytest

from emgs_jax.config.configure import CONF
from experiments.cli import COMMANDS, main, usage

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SETUP = PROJECT["tool"]["setuptools"]


def folder_of(package: str) -> Path:
    """As setuptools maps packages to folders: by the longest name that is mapped."""
    name = package
    while name not in SETUP["package-dir"]:
        name = name.rpartition(".")[0]
    return ROOT / SETUP["package-dir"][name] / package[len(name) :].lstrip(".").replace(".", "/")


def test_every_folder_of_code_is_a_package_that_is_installed_below_our_name():
    code = {path.parent for top in ("emgs_jax", "experiments") for path in (ROOT / top).rglob("*.py")}
    assert {folder_of(package) for package in SETUP["packages"]} == code | {ROOT / "conf"}
    assert {package.split(".")[0] for package in SETUP["packages"]} == {"emgs_jax"}
    assert len(set(SETUP["packages"])) == len(SETUP["packages"])


def test_the_type_marker_and_every_yaml_are_installed():
    assert (ROOT / "emgs_jax" / "py.typed").is_file() and SETUP["package-data"]["emgs_jax"] == ["py.typed"]
    assert SETUP["package-data"]["emgs_jax.conf"] == ["**/*.yaml"]
    assert {path.suffix for path in CONF.rglob("*") if path.is_file()} == {".yaml"}


def test_the_sources_of_the_report_are_installed_and_are_readable_text():
    """No bundle of others: short files, short lines."""
    assert SETUP["package-data"]["emgs_jax.report"] == ["web/*", "published.yaml"]
    sources = sorted((ROOT / "emgs_jax" / "report" / "web").iterdir())
    assert {path.suffix for path in sources} == {".html", ".css", ".js", ".vert", ".frag"}
    for path in sources:
        lines = path.read_text().splitlines()
        assert len(lines) <= 300 and max(map(len, lines)) <= 120, path


def test_the_scripts_import_each_other_by_relative_names_so_that_they_work_under_both():
    for path in (ROOT / "experiments").rglob("*.py"):
        assert "from experiments" not in path.read_text() and "import experiments" not in path.read_text(), path


def test_every_command_is_listed_with_an_example_and_an_unknown_one_is_named(monkeypatch, capsys):
    assert PROJECT["project"]["scripts"] == {"emgs": "emgs_jax.experiments.cli:main"}
    programs = {path.stem for path in (ROOT / "experiments").glob("*.py") if 'command("' in path.read_text()}
    assert set(COMMANDS) == programs
    monkeypatch.setattr("sys.argv", ["emgs", "--help"])
    main()
    assert capsys.readouterr().out.rstrip() == usage()
    assert all(f"emgs {name} " in usage() for name in COMMANDS)
    monkeypatch.setattr("sys.argv", ["emgs", "fly"])
    with pytest.raises(SystemExit, match="fly is no command of emgs: choose one of run, ros, merge"):
        main()

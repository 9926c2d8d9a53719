"""docs/report.html, the page that README links to: of the form that pages have now, and of no machine."""

import re
from pathlib import Path

from emgs_jax.report.page import _SCRIPTS, source

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "report.html").read_text(encoding="utf-8")
AGAIN = "write it again with the command in README.md"


def test_it_has_the_form_of_the_pages_that_are_written_now():
    """All of their own source stands in it: templates but for what is filled in, styles, programs."""
    whole = [source("page.css"), source("splats.vert"), source("splats.frag"), "\n".join(map(source, _SCRIPTS))]
    pieces = [piece for name in ("shell", "page", "programs") for piece in re.split(r"\{\w+\}", source(f"{name}.html"))]
    assert all(part in TEXT for part in [*whole, *pieces]), AGAIN


def test_it_is_simulated_not_large_and_names_neither_a_machine_nor_an_address():
    assert len(TEXT.encode()) <= 2_000_000 and "SIMULATED" in TEXT
    words = re.sub(r"[A-Za-z0-9+/=]{300,}", "", TEXT)  # without pictures and the map, which are base64
    assert len(words) < 100_000, "what is left is words and programs"
    assert not re.search(r"/(root|home|tmp|usr|work|mnt|Users)\b|[A-Z]:\\|https?://|\d+\.\d+\.\d+\.\d+", words)


def test_readme_has_the_command_that_writes_it():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"^(emgs run .*) && cp .*docs/report\.html$", readme, re.MULTILINE)
    assert command == "emgs run hydra.run.dir=outputs/sample", "what the first command writes"

"""docs/report.html, the page that README links to: small, of no machine, and written by the command in CONTRIBUTING.md.

That it opens and has the parts of today's pages is seen in the browser: test_page_browser.py.
"""

import re
from pathlib import Path

from page_elements import Elements

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "docs" / "report.html"


def test_it_is_simulated_not_large_has_its_parts_and_names_neither_a_machine_nor_an_address():
    text = SAMPLE.read_text(encoding="utf-8")
    assert len(text.encode()) <= 2_000_000 and "SIMULATED" in text
    words = re.sub(r"[A-Za-z0-9+/=]{300,}", "", text)  # without pictures and the map, which are base64
    assert len(words) < 100_000, "what is left is words and programs"
    assert not re.search(r"/(root|home|tmp|usr|work|mnt|Users)\b|[A-Z]:\\|https?://|\d+\.\d+\.\d+\.\d+", words)
    assert {"about", "arrays", "vertex", "fragment"} <= {*Elements(text).scripts}, "write it again, see CONTRIBUTING.md"


def test_contributors_have_the_command_that_writes_it():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"^(emgs run .*) && cp .*docs/report\.html$", text, re.MULTILINE)
    assert command == "emgs run hydra.run.dir=outputs/sample", "what the first command writes"

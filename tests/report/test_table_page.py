"""Pages of evaluations as text, and in Chromium; oracles: an HTML parser, runs made by hand, known sizes."""

import base64
import io
import json
import re
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote

import numpy as np
import pytest
from page_elements import HOSTILE, Elements
from PIL import Image
from written_run import written_run

from emgs_jax.io.files import write_json
from emgs_jax.report import html
from emgs_jax.report.evaluation_page import Found, JobLine, verdict, write_evaluation_page
from emgs_jax.report.html import thumbnails
from emgs_jax.report.tables import average
from emgs_jax.runs.results import estimates_of

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("browser")]

ATE, F1 = "trajectory/ate_sim3_m", "reconstruction/f1_5cm_percent"
COMMAND = "emgs evaluate suite=smoke"


def picture_at(path: Path, size: tuple[int, int] = (800, 500), noise: int = 0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(0).integers(0, 1 + noise, (*size[::-1], 3), np.uint8)
    Image.fromarray(pixels).save(path, path.suffix[1:].replace("jpg", "jpeg"))


def evaluation(out: Path, *, missing: str = "disk full", gate=None, regressions=(), name: str = "room 0/a b") -> Found:
    """Two finished runs of which one is worse than the prior, and one without a result."""
    jobs = []
    for seed, ours in ((0, 0.012), (1, 0.04)):
        folder = written_run(out / "synthetic" / "room #0" / "default" / str(seed), **{ATE: ours, F1: 60.0})
        picture_at(folder / "overview.png")
        (folder / "report.html").write_text("a page")
        jobs.append(JobLine(f"{name}/{seed}", folder, ""))
    jobs.append(JobLine("third", out / "third", missing))
    estimates = [item for job in jobs[:2] for item in estimates_of(job.folder / "metrics.json")]
    return Found(jobs, average(estimates, each_sequence=True), estimates, gate, regressions)


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("evaluation")
    return write_evaluation_page(out, evaluation(out, gate="gate.yaml", regressions=["ATE is 4, baseline 3"]), COMMAND)


def words_of(path: Path) -> str:
    """The text of a page, its elements left out."""
    return re.sub(r"<[^>]*>", " ", re.sub(r"<style.*?</style>", "", path.read_text(), flags=re.DOTALL))


def test_an_evaluation_says_what_became_of_every_run_and_what_is_worse(page):
    text = " ".join(words_of(page).split())
    assert "2 of 3 runs are finished" in text and "in 1 of 2; 1 is worse than the gate allows" in text
    assert "path off by 1.2 cm (prior alone: 3.0 cm)" in text and "not finished: disk full" in text
    assert "ATE is 4, baseline 3" in text and "SIMULATED" in text and COMMAND in text
    assert re.search(r"ours simulated paper/sim3 2 2\.60 ± 1\.98", text)  # 1.2 and 4 cm: deviation 2.8 / √2
    assert re.search(r"raw prior simulated paper/sim3 2 3\.00 ± 0\.00", text)
    assert page.read_text().count('class="best"') == 1  # no other metric has two values
    assert '<td class="best">2.60 ± 1.98</td>' in page.read_text()


def test_links_are_relative_and_lead_to_the_runs_and_no_program_may_run(page):
    elements = Elements(page.read_text())
    links = [attributes["href"] for tag, attributes in elements.found if tag == "a"]
    assert len(links) == 4  # report and folder of each finished run
    for link in links:
        assert link.startswith("./") and (page.parent / unquote(link)).exists(), link
    assert "%230" in links[0], "a # would end the address"
    (policy,) = [a["content"] for _, a in elements.found if a.get("http-equiv") == "Content-Security-Policy"]
    assert policy == "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def test_the_page_opens_in_a_browser_without_a_request_or_an_error(page, chromium):
    chromium.fresh().visit(page.resolve().as_uri())
    assert chromium.run("return [...document.images].map((i) => i.naturalWidth)") == [360, 360]
    assert {address.split(":")[0] for address in chromium.requests()} <= {"file", "data"}
    assert not chromium.errors()
    chromium.run("document.querySelector('a').click()")
    assert chromium.run("return document.body.textContent") == "a page"


def test_hostile_words_stay_text_and_the_results_of_another_program_are_no_job(tmp_path):
    """A scored system has no folder of a run: its row is in the table, and nothing claims a report of it."""
    found = evaluation(tmp_path, missing=HOSTILE, gate=HOSTILE, regressions=[HOSTILE], name=HOSTILE)
    folder = tmp_path / "synthetic" / "room0" / "peer" / "0"
    metrics = json.loads((found.jobs[0].folder / "metrics.json").read_text())
    metrics["provenance"]["prior"] = None
    folder.mkdir(parents=True)
    write_json(folder / "metrics.json", {ATE: 0.5, "provenance": metrics["provenance"]})
    estimates = [*found.estimates, *estimates_of(folder / "metrics.json")]
    found = found._replace(estimates=estimates, rows=average(estimates, each_sequence=True))
    path = write_evaluation_page(tmp_path, found, HOSTILE)
    assert "peer scored" in " ".join(words_of(path).split())
    elements = Elements(path.read_text())
    assert not elements.scripts and not any(name.startswith("on") for _, found in elements.found for name in found)


def test_what_is_simulated_is_not_better_than_what_is_measured(tmp_path):
    """They must not be set beside each other: each has its own best."""
    shared = {"dataset": "room", "sequences": ("one",), "protocol": "p", "variant": "default", "seeds": (0,)}
    rows = [
        SimpleNamespace(**shared, spreads={}, kind=kind, is_simulated=is_simulated, values={ATE: error})
        for kind, is_simulated, error in zip("abcd", (True, True, False, False), (0.02, 0.05, 0.03, 0.04), strict=True)
    ]
    text = write_evaluation_page(tmp_path, Found([], rows, []), "").read_text()
    lines = [line for line in re.findall(r"<tr.*?</tr>", text, re.DOTALL) if "room" in line]
    assert ['class="best"' in line for line in lines] == [True, False, True, False]


def test_the_verdict_is_bad_where_something_is_missing_or_worse_and_mixed_where_a_run_is_worse_than_the_prior(tmp_path):
    found = evaluation(tmp_path)
    assert verdict(found)[0] == "bad"
    both = found._replace(jobs=found.jobs[:2])
    assert verdict(both)[0] == "mixed" and verdict(both._replace(jobs=found.jobs[:1]))[0] == "good"
    assert verdict(both._replace(gate="g", regressions=["worse"]))[0] == "bad"
    assert verdict(both._replace(gate="g")) == (
        "mixed",
        verdict(both)[1][:-1] + "; nothing is worse than the gate allows.",
    )
    assert verdict(Found([], [], [])) == ("unknown", "0 of 0 runs are finished.")
    text = words_of(write_evaluation_page(tmp_path, Found([JobLine("first", tmp_path / "first", "to do")], [], []), ""))
    assert "0 of 1 runs are finished" in text and "not finished: to do" in text


def test_pictures_are_as_large_as_all_of_them_fit(tmp_path, monkeypatch):
    paths = [tmp_path / f"{number}.png" for number in range(4)]
    for path in paths[:3]:
        picture_at(path, noise=255)
    paths[2].write_bytes(b"no picture")
    widths = {}
    for budget in (10**7, 40_000, 10_000):
        monkeypatch.setattr(html, "PICTURE_BYTES", budget)
        found = thumbnails(paths)
        assert found[2:] == ["", ""] and sum(map(len, found)) <= budget
        widths[budget] = [Image.open(io.BytesIO(base64.b64decode(text))).width for text in found if text]
    assert widths[10**7] == [360, 360] and widths[40_000][0] < 360 and len(widths[10_000]) == 2
    monkeypatch.setattr(html, "PICTURE_BYTES", int(1.5 * len(found[0])))
    assert [bool(text) for text in thumbnails(paths)] == [True, False, False, False]  # the first that fit

"""README, docs/ and CONTRIBUTING name only what is there: files, commands, options, config keys; no private page."""

import importlib.util
import re
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from scene import CONF, compose

import emgs_jax
from emgs_jax.config.overrides import readable
from experiments.command import check_arguments
from experiments.evaluate import delegated
from experiments.ros import with_topics
from experiments.shorthand import CAMERA, of_camera

ROOT = CONF.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
GROUPS = ("dataset", "prior", "features", "evaluation", "experiment", "suite", "protocol")

BLOCK = re.compile(r"^```\w*\n(.*?)^```", re.DOTALL | re.MULTILINE)


@cache
def code(page: Path) -> str:
    """What stands in blocks and spans of code, a line each."""
    text = page.read_text()
    return "\n".join(BLOCK.findall(text) + re.findall(r"`([^`\n]+)`", BLOCK.sub("", text)))


def slug(heading: str) -> str:
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def test_links_lead_to_files_and_headings_that_are_there():
    dead = []
    for page in PAGES:
        for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
            target, _, heading = link.partition("#")
            if not target.startswith("http"):
                path = page.parent / target if target else page
                text = path.read_text() if heading and path.exists() else ""
                slugs = {slug(line) for line in re.findall(r"^#+ (.*)$", text, re.MULTILINE)}
                if not path.exists() or (heading and heading not in slugs):
                    dead.append(f"{page.name}: {link}")
    assert not dead


def test_commands_options_and_files_are_there():
    """And infinity is `inf`, as a command line reads it; YAML's own `.inf` would be text there."""
    unknown = []
    for page in PAGES:
        names = re.findall(r"(?:python -m experiments\.|\bemgs )([a-z]\w*)", code(page))
        unknown += [
            f"{page.name}: emgs {name}" for name in names if not importlib.util.find_spec(f"experiments.{name}")
        ]
        options = re.findall(rf"(?<![\w./])({'|'.join(GROUPS)}|slam/\w+)=([a-z]\w*)", code(page))
        files = {f"{group}={option}": CONF / group / f"{option}.yaml" for group, option in options}
        folders = "emgs_jax|conf|tests|docs|notebooks|experiments"
        files |= {name: ROOT / name for name in re.findall(rf"^((?:{folders})/[\w./]+)$", code(page), re.MULTILINE)}
        unknown += [f"{page.name}: {name}" for name, path in files.items() if not path.exists()]
        unknown += [f"{page.name}: {word}" for word in re.findall(r"=-?\.(?:inf|nan)", code(page))]
    assert not unknown


def commands(page: Path) -> set[tuple[str, ...]]:
    """Name of each command of a page and its overrides, without those that are left to the reader ("…")."""
    found = set()
    for part in re.split(r"&&|\n", code(page).replace("\\\n", " ")):
        part = part.replace("python -m experiments.", "emgs ")
        if re.match(r"\s*emgs [a-z]", part) and "$PWD" not in part:
            _, name, *words = shlex.split(part, comments=True)
            given = [word for word in words if "=" in word and "…" not in word]
            if name == "run" and words and CAMERA.match(words[0]):
                given = of_camera(words[0], given)
            elif name == "run" and words and re.fullmatch(r"[\w/.]+", words[0]):  # what a video stands for
                given = ["dataset=images", "prior=multiview_stereo", *given]
            if name == "ros":
                given = with_topics(given)
            if name == "evaluate":
                has_suite = any(word.startswith("suite=") for word in given)
                given = delegated(given if has_suite else ["suite=smoke", *given])
            found.add((name, *given))
    return found


@pytest.mark.slow
def test_every_command_composes_its_config():
    """Keys, options and their values: those of what is named here, `mine/` aside, which test_extending.py runs."""
    wrong = {}
    for words in sorted({words for page in PAGES for words in commands(page) if len(words) > 1}):
        try:
            check_arguments("config" if words[0] == "run" else words[0], readable(list(words[1:])))
        except Exception as error:  # noqa: BLE001 (every wrong one at once)
            wrong[" ".join(words)] = error
    assert not wrong


def test_keys_of_the_stages_are_keys_of_the_config():
    """A key has a value after it, or is the whole span."""
    config = compose()
    unknown = []
    for page in PAGES:
        keys = re.findall(r"\b((?:slam|render|densify|evaluation)\.[a-z_0-9.]+)[=:]", code(page))
        keys += re.findall(r"^((?:slam)\.[a-z_0-9]+\.[a-z_0-9.]+)$", code(page), re.MULTILINE)
        for key in keys:
            parent, _, last = key.rpartition(".")
            if last not in (OmegaConf.select(config, parent) or {}):
                unknown.append(f"{page.name}: {key}")
    assert not unknown


def test_the_documentation_lists_every_room_of_the_package():
    text = next(block for block in BLOCK.findall((ROOT / "docs" / "how_it_works.md").read_text()) if "\nops/" in block)
    listed = {line.split()[0] for line in text.splitlines() if re.match(r"[a-z_]+/? ", line)}
    found = [path for path in (ROOT / "emgs_jax").iterdir() if not path.name.startswith(("_", "."))]
    files = {path.stem for path in found if path.suffix == ".py"}
    assert listed == files | {f"{path.name}/" for path in found if path.is_dir()}


def test_nothing_refers_to_pages_that_users_do_not_have():
    """`design/` and `reference/` are no folders of this project, and there is no path of a machine."""
    private = re.compile(r"\b(design|reference)/\w|\bmethod\.md|/work/|\.\./shared")
    folders = ("emgs_jax", "experiments", "conf", "docs", "notebooks")
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*")]
    paths = [path for path in paths if path.suffix in (".py", ".yaml", ".md", ".ipynb")]
    assert not [path for path in paths if private.search(path.read_text())]


def test_instructions_are_short_and_have_no_history():
    """Measurements are dated and name their commits; they stand in docs/measurements/."""
    commit = re.compile(r"`(?=[a-f]*\d)(?=\d*[a-f])[0-9a-f]{7,12}`")
    texts = {page.name: page.read_text() for page in (ROOT / "docs").glob("*.md")}
    assert not [name for name, text in texts.items() if len(text.split()) > 1500 or commit.search(text)]


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_has_every_key_and_name(tmp_path):
    """As `mkdocs build --strict` does: every link and anchor is there, and so is every page of the navigation."""
    pytest.importorskip("mkdocs")
    words = ["build", "--strict", "--quiet", "--config-file", str(ROOT / "mkdocs.yml"), "--site-dir", str(tmp_path)]
    done = subprocess.run([sys.executable, "-m", "mkdocs", *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    keys = (tmp_path / "every_key.html").read_text()
    assert all(str(path.relative_to(CONF)) in keys for path in CONF.rglob("*.yaml"))
    assert "The keys that people change" in (tmp_path / "keys.html").read_text(), "a page of docs/ is not replaced"
    names = (tmp_path / "names.html").read_text()
    assert all(f'id="{name.lower()}"' in names for name in emgs_jax.__all__ if name != "__version__")

"""Choice of mutants, and of the tests that may notice each: read from the source alone, so that all get the same."""

import ast
import hashlib
import math
import re
from collections import Counter
from functools import cache
from pathlib import Path
from typing import NamedTuple

from tools.mutants.by_hand import BY_HAND
from tools.mutants.operators import Edit, changed, edits

ROOT = Path(__file__).resolve().parents[2]
CORE = "ops observation gaussians gaussian_map registration pose_graph render initialization localization em"
CORE = {*CORE.split(), "surface_extrapolation", "splitting", "refinement", "existence", "motion", "semantics", "slam"}
CORE_SHARE = 0.5  # of a sample; the core is a fifth of the source, and an error in it the hardest to see
MOST_OF_A_KIND = 0.15  # of a sample; a third of all places are numbers


class Mutant(NamedTuple):
    file: str
    edit: Edit

    def __str__(self) -> str:
        before, after = (re.sub(r"\s+", " ", text) for text in (self.edit.before, self.edit.after))
        return f"{self.file}:{self.edit.line} [{self.edit.kind}] {before[:60]} -> {after[:60] or 'nothing'}"


def digest(*parts: object) -> str:
    return hashlib.sha256("\0".join(map(str, parts)).encode()).hexdigest()


def sources() -> list[str]:
    return sorted(
        str(path.relative_to(ROOT)) for name in ("emgs_jax", "experiments") for path in (ROOT / name).rglob("*.py")
    )


def is_core(file: str) -> bool:
    return file.startswith("emgs_jax/") and Path(file).with_suffix("").parts[1] in CORE


def by_hand() -> list[Mutant]:
    """Those that no operator makes.

    Raises:
        ValueError: a text does not occur exactly once.
    """
    found = []
    for name, before, after, bug in BY_HAND:
        file = f"emgs_jax/{name}.py"
        source = (ROOT / file).read_text()
        if source.count(before) != 1:
            raise ValueError(f"{file}: found {source.count(before)} times, not once: {before!r}")
        above = source[: source.index(before)]
        found.append(Mutant(file, Edit(len(above.encode()), above.count("\n") + 1, "", bug, before, after)))
    return found


@cache
def places() -> dict[Mutant, str]:
    """All that the generator makes, each with what it is, wherever it stands."""
    found, alike = {}, Counter()
    for file in sources():
        for edit in edits((ROOT / file).read_text(), file):
            about = file, *edit[2:]
            alike[about] += 1
            found[Mutant(file, edit)] = digest(*about, alike[about])
    return found


def sample(count: int, seed: int) -> list[Mutant]:
    """So many of all: half of them of the core, no two on one line, of no kind too many.

    Each has its own random place in the order, of which a change elsewhere in the source moves none.
    """
    chosen: list[Mutant] = []
    for of_core, share in ((True, CORE_SHARE), (False, 1 - CORE_SHARE)):
        wanted, lines, kinds = round(share * count), set(), Counter()
        for one in sorted(places(), key=lambda one: digest(seed, places()[one])):
            place = one.file, one.edit.line
            is_full = kinds[one.edit.kind] >= math.ceil(MOST_OF_A_KIND * wanted)
            if (
                is_core(one.file) != of_core
                or place in lines
                or is_full
                or kinds.total() == wanted
                or not compiles(one)
            ):
                continue
            lines.add(place)
            kinds[one.edit.kind] += 1
            chosen.append(one)
    return chosen


def compiles(mutant: Mutant) -> bool:
    source = (ROOT / mutant.file).read_text()
    try:
        return ast.dump(ast.parse(changed(source, mutant.edit))) != ast.dump(ast.parse(source))
    except SyntaxError:
        return False


@cache
def importers() -> dict[str, set[str]]:
    """For every file those that import it; tests also where they mention it or an option of conf/ that names it."""
    files = [*sources(), *(str(path.relative_to(ROOT)) for path in (ROOT / "tests").rglob("*.py"))]
    names = {file.removesuffix(".py").replace("/", "."): file for file in files}
    names |= {Path(file).stem: file for file in files if file.startswith("tests/")}
    found: dict[str, set[str]] = {file: set() for file in files}
    options = targets()
    for file in files:
        source = (ROOT / file).read_text()
        said = set()
        if file.startswith("tests/"):
            said |= set(re.findall(r"\b(?:emgs_jax|experiments)(?:\.\w+)+", source))
            said |= {name for option in re.findall(r"[\w/]+=\w+", source) for name in options.get(option, ())}
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Import):
                said |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                said |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
        for name in said & names.keys():
            found[names[name]].add(file)
    return found


def targets() -> dict[str, list[str]]:
    """The modules of which an option of conf/ makes something, by its name (`prior=recorded`)."""
    found = {}
    for path in (ROOT / "conf").rglob("*.yaml"):
        option = f"{path.parent.relative_to(ROOT / 'conf').as_posix()}={path.stem}"
        found[option] = re.findall(r"_target_: (\w+(?:\.\w+)+)\.\w+", path.read_text())
    return found


def home(file: str) -> Path:
    """Return the folder of a file's tests."""
    return Path("tests", *(Path(file).parent.parts[1:] if file.startswith("emgs_jax/") else ["scripts"]))


def nearest_tests(file: str, reach: int) -> list[str]:
    """A file's own tests, then those that import it, directly or through `reach` - 1 others, the nearest first."""
    own = (ROOT / home(file)).glob(f"test_{Path(file).stem}*.py")
    found = dict.fromkeys(sorted(str(path.relative_to(ROOT)) for path in own))
    seen = newest = {file}
    for _ in range(reach):
        newest = {other for one in newest for other in importers()[one]} - seen
        seen = seen | newest
        found |= dict.fromkeys(sorted(one for one in newest if Path(one).name.startswith("test_")))
    return list(found)

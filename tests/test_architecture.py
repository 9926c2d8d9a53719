"""The house's rules, read from the source: ranks of imports, host-only packages, no pickle, docstrings.

What is core follows from the folder: everything but the rooms in `HOST` and `HOST_FILES` is pure and jitted.
"""

import ast
import re
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "emgs_jax"
FILES = sorted(PACKAGE.rglob("*.py"))
# From the bottom: a room imports rooms to its left and itself, never one to its right.
CORE_ROOMS = (
    *("ops", "observation", "gaussians", "gaussian_map", "sight", "registration", "pose_graph", "render"),
    *("initialization", "localization", "em", "surface_extrapolation", "splitting", "refinement", "existence"),
    *("layers", "motion", "semantics", "slam"),
)
# What is solved between frames, by SciPy; the core does not import it.
HOST_FILES = {"pose_graph.sparse", "pose_graph.chordal", "pose_graph.problem", "pose_graph.optimize"}
HOST = (
    *(
        "geometry",
        "data",
        "io",
        "live",
        "features",
        "keypoints",
        "loop_closure",
        "structure",
        "scale",
        "prior",
        "evaluation",
        "device",
    ),
    *("back_end", "mapping", "config", "sequence", "polish", "drawing", "runs", "report", "viewer"),
)
STAGES = {
    *("initialization", "localization", "em", "surface_extrapolation", "splitting", "refinement", "existence"),
    *("motion", "semantics"),
}
HOST_PACKAGES = {"numpy", "cv2", "open3d", "trimesh", "matplotlib", "scipy", "torch", "tqdm", "hydra", "omegaconf"}


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


def room_of(name: str) -> str:
    return name.split(".")[0]


def is_core(path: Path) -> bool:
    return room_of(name_of(path)) not in (*HOST, "__init__") and name_of(path) not in HOST_FILES


CORE = [path for path in FILES if is_core(path) and path.name != "__init__.py"]


@cache
def imports_of(path: Path) -> frozenset[str]:
    """Full names of the imported modules, those inside functions included; a module imported by name counts as such."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import in {path}"
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            modules = {name for name in names if (PACKAGE.parent / (name.replace(".", "/") + ".py")).exists()}
            found |= modules or {node.module}
    return frozenset(found)


def inner(path: Path) -> set[str]:
    return {name.removeprefix("emgs_jax.") for name in imports_of(path) if name.startswith("emgs_jax.")}


def test_every_room_has_its_place():
    rooms = {room_of(name_of(path)) for path in FILES} - {"__init__"}
    assert rooms == {*CORE_ROOMS, *HOST}


def test_imports_go_downwards_only():
    ranks = {room: rank for rank, room in enumerate([*CORE_ROOMS, *HOST])}
    files = [path for path in FILES if room_of(name_of(path)) != "__init__"]
    late = {
        name_of(path): upwards
        for path in files
        if (upwards := {name for name in inner(path) if ranks[room_of(name)] > ranks[room_of(name_of(path))]})
    }
    assert not late


def test_no_file_imports_itself_through_others():
    graph = {name_of(path): inner(path) for path in FILES}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"a circle of imports: {error.args[1]}")


def test_rooms_stand_on_at_most_ten_ranks():
    below: dict[str, set[str]] = {}
    for path in FILES:
        room = room_of(name_of(path))
        below.setdefault(room, set()).update(room_of(name) for name in inner(path) if room_of(name) != room)

    @cache
    def rank(room: str) -> int:
        return 1 + max(map(rank, below.get(room, ())), default=0)

    assert max(map(rank, below)) <= 10, {room: rank(room) for room in below}


def test_no_stage_imports_another_stage():
    others = {stage: found for stage in STAGES if (found := inner(PACKAGE / f"{stage}.py") & STAGES)}
    assert not others


def test_host_packages_stay_out_of_the_core():
    of_host = {
        name_of(path): found
        for path in CORE
        if (found := {name.split(".")[0] for name in imports_of(path)} & HOST_PACKAGES | inner(path) & HOST_FILES)
    }
    assert not of_host


def test_the_mapping_does_not_read_its_log():
    """Records are written from events and from the pose graph, by the files that run a sequence."""
    log, mapping = {"mapping.records", "mapping.run"}, (PACKAGE / "mapping").glob("*.py")
    readers = {path.stem for path in mapping if inner(path) & log}
    assert readers == {"run", "pipeline", "checkpoint"}


def test_no_two_files_of_tests_share_a_name():
    # Tests are collected as top-level modules: of two with one name pytest refuses the second, in a whole run only.
    names = [path.name for path in Path(__file__).parent.rglob("test_*.py")]
    assert sorted(set(names)) == sorted(names)


def test_nothing_is_pickled():
    pickles = {"pickle", "dill", "cloudpickle", "joblib", "shelve"}
    found = [path for path in FILES if pickles & imports_of(path) or "allow_pickle=True" in path.read_text()]
    assert not found


def test_text_is_utf_8_whatever_the_machine_speaks():
    """In a container without a locale the first step of a run ended with "'ascii' codec can't decode byte"."""
    offenders = []
    for path in [*FILES, *sorted((PACKAGE.parent / "experiments").rglob("*.py"))]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            named = {keyword.arg for keyword in node.keywords}
            words = [argument.value for argument in node.args if isinstance(argument, ast.Constant)]
            is_open = isinstance(node.func, ast.Name) and node.func.id == "open" and not {"rb", "wb"} & {*words}
            is_text = isinstance(node.func, ast.Attribute) and node.func.attr in ("read_text", "write_text")
            ours = ast.unparse(node.func) == "reading.read_text"
            is_process = ast.unparse(node.func).startswith("subprocess.") and "text" in named
            if "encoding" not in named and not ours and (is_open or is_text or is_process):
                offenders.append(f"{path}:{node.lineno}")
    assert not offenders


def test_weights_are_loaded_as_tensors_only():
    calls = [(path, call) for path in FILES for call in re.findall(r"torch\.load\(.*?\)", path.read_text(), re.DOTALL)]
    assert not [(path, call) for path, call in calls if "weights_only=True" not in call]


def test_pytorch_is_imported_inside_functions_only_so_that_the_rest_works_without_it():
    offenders = []
    for path in [*FILES, *sorted((PACKAGE.parent / "experiments").glob("*.py"))]:
        for node in ast.parse(path.read_text()).body:  # what is inside `if TYPE_CHECKING` is for readers and checkers
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module]
                if {str(name).split(".")[0] for name in names} & {"torch", "torchvision", "transformers"}:
                    offenders.append(path)
    assert not offenders


def test_every_public_function_and_class_of_the_core_says_what_it_does():
    silent = []
    for path in CORE:
        tree = ast.parse(path.read_text())
        public = [n for n in tree.body if isinstance(n, (ast.FunctionDef, ast.ClassDef)) and not n.name.startswith("_")]
        silent += [f"{name_of(path)}.{getattr(n, 'name', '')}" for n in (tree, *public) if not ast.get_docstring(n)]
    assert not silent

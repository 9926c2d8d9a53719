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
    *("ops", "observation", "gaussians", "gaussian_map", "registration", "pose_graph", "render"),
    *("initialization", "localization", "em", "surface_extrapolation", "splitting", "refinement", "existence"),
    *("layers", "motion", "semantics", "slam"),
)
# What is solved between frames, by SciPy; the core does not import it.
HOST_FILES = {"pose_graph.sparse", "pose_graph.chordal", "pose_graph.problem", "pose_graph.optimize"}
HOST = (
    "geometry",
    "data",
    "io",
    "features",
    "keypoints",
    "loop_closure",
    "structure",
    "prior",
    "evaluation",
    "device",
    "back_end",
    "mapping",
    "config",
    "sequence",
    "polish",
    "report",
)
STAGES = {
    "initialization",
    "localization",
    "em",
    "surface_extrapolation",
    "splitting",
    "refinement",
    "existence",
    "motion",
    "semantics",
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


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_imports_go_downwards_only(path):
    order, room = [*CORE_ROOMS, *HOST], room_of(name_of(path))
    if room != "__init__":
        late = {name for name in inner(path) if order.index(room_of(name)) > order.index(room)}
        assert not late, f"{name_of(path)} imports {late}"


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
    for stage in STAGES:
        assert not inner(PACKAGE / f"{stage}.py") & STAGES, stage


@pytest.mark.parametrize("path", CORE, ids=name_of)
def test_host_packages_stay_out_of_the_core(path):
    assert not {module.split(".")[0] for module in imports_of(path)} & HOST_PACKAGES
    assert not inner(path) & HOST_FILES


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
    for path in FILES:
        assert not {"pickle", "dill", "cloudpickle", "joblib", "shelve"} & imports_of(path), path
        assert "allow_pickle=True" not in path.read_text(), path


def test_text_is_utf_8_whatever_the_machine_speaks():
    """In a container without a locale the first step of a run ended with "'ascii' codec can't decode byte"."""
    for path in [*FILES, *sorted((PACKAGE.parent / "experiments").rglob("*.py"))]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            named = {keyword.arg for keyword in node.keywords}
            words = [argument.value for argument in node.args if isinstance(argument, ast.Constant)]
            is_open = isinstance(node.func, ast.Name) and node.func.id == "open" and not {"rb", "wb"} & {*words}
            is_text = isinstance(node.func, ast.Attribute) and node.func.attr in ("read_text", "write_text")
            ours = ast.unparse(node.func) == "reading.read_text"
            assert "encoding" in named or ours or not (is_open or is_text), f"{path}:{node.lineno}"
            is_process = ast.unparse(node.func).startswith("subprocess.") and "text" in named
            assert not is_process or "encoding" in named, f"{path}:{node.lineno}"


def test_weights_are_loaded_as_tensors_only():
    for path in FILES:
        for call in re.findall(r"torch\.load\(.*?\)", path.read_text(), re.DOTALL):
            assert "weights_only=True" in call, path


def test_pytorch_is_imported_inside_functions_only_so_that_the_rest_works_without_it():
    for path in [*FILES, *sorted((PACKAGE.parent / "experiments").glob("*.py"))]:
        tree = ast.parse(path.read_text())
        for node in tree.body:  # what is inside `if TYPE_CHECKING` is for readers and type checkers
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module]
                assert not {str(name).split(".")[0] for name in names} & {"torch", "torchvision", "transformers"}, path


@pytest.mark.parametrize("path", CORE, ids=name_of)
def test_every_public_function_and_class_of_the_core_says_what_it_does(path):
    tree = ast.parse(path.read_text())
    assert ast.get_docstring(tree)
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
            assert ast.get_docstring(node), node.name

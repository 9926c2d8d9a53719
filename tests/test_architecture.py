"""The house's rules, read from the source: ranks of imports, host-only packages, no pickle, short functions."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "emgs_jax"
FILES = sorted(PACKAGE.rglob("*.py"))
# design/layout.md: a file imports only files listed before it.
CORE = (
    *(
        "pytree",
        "linalg",
        "rigid",
        "camera",
        "observation",
        "selection",
        "neighbours",
        "clustering",
        "gaussians",
        "gaussian_map",
        "matching",
        "icp",
    ),
    *("render.project", "render.tiles", "render.composite", "render.densify"),
    *("initialization", "localization", "em", "refinement", "slam", "semantics", "sweep"),
    *("stereo.bundle_adjustment", "stereo.plane_sweep", "stereo.semi_global", "stereo.depth"),
)
STAGES = {"initialization", "localization", "em", "refinement"}
HOST_PACKAGES = {"numpy", "cv2", "open3d", "trimesh", "matplotlib", "scipy", "torch", "tqdm", "hydra", "omegaconf"}


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


def imports_of(path: Path) -> set[str]:
    """Full names of the imported modules, those inside functions included."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import in {path}"
            found.add(node.module)
    return found


def inner(path: Path) -> set[str]:
    return {name.removeprefix("emgs_jax.") for name in imports_of(path) if name.startswith("emgs_jax.")}


@pytest.mark.parametrize("name", CORE)
def test_a_file_of_the_core_imports_only_files_listed_before_it(name):
    path = PACKAGE / (name.replace(".", "/") + ".py")
    late = inner(path) - set(CORE[: CORE.index(name)])
    assert not late, f"{name} imports {late}"


def test_no_stage_imports_another_stage():
    for stage in STAGES:
        assert not inner(PACKAGE / f"{stage}.py") & STAGES, stage


@pytest.mark.parametrize("name", CORE)
def test_host_packages_stay_out_of_the_core(name):
    path = PACKAGE / (name.replace(".", "/") + ".py")
    assert not {module.split(".")[0] for module in imports_of(path)} & HOST_PACKAGES


def test_every_other_file_is_a_host_file_and_the_core_imports_none():
    others = {name_of(path) for path in FILES if path.name != "__init__.py"} - set(CORE)
    for name in CORE:
        assert not inner(PACKAGE / (name.replace(".", "/") + ".py")) & others


def test_nothing_is_pickled():
    for path in FILES:
        assert not {"pickle", "dill", "cloudpickle", "joblib", "shelve"} & imports_of(path), path
        assert "allow_pickle=True" not in path.read_text(), path


def test_pytorch_is_imported_inside_functions_only_so_that_the_rest_works_without_it():
    for path in [*FILES, *sorted((PACKAGE.parent / "experiments").glob("*.py"))]:
        tree = ast.parse(path.read_text())
        for node in tree.body:  # what is inside `if TYPE_CHECKING` is for readers and type checkers
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module]
                assert not {name.split(".")[0] for name in names} & {"torch", "torchvision", "transformers"}, path


def functions():
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                yield path, node


def test_no_function_is_longer_than_60_lines():
    long = [
        f"{name_of(p)}.{f.name}: {f.end_lineno - f.lineno + 1}" for p, f in functions() if f.end_lineno - f.lineno >= 60
    ]
    assert not long


def test_every_public_function_and_class_of_the_core_says_what_it_does():
    for name in CORE:
        tree = ast.parse((PACKAGE / (name.replace(".", "/") + ".py")).read_text())
        assert ast.get_docstring(tree), name
        for node in tree.body:
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
                assert ast.get_docstring(node), f"{name}.{node.name}"

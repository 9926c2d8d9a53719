"""Hook of mkdocs: generate a page of every key in `conf/` and a page of every name of `emgs_jax`."""

import ast
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
CONF, PACKAGE = ROOT / "conf", ROOT / "emgs_jax"
KEYS = """# Every key

Every file of `conf/` in this version. `emgs run --cfg job` prints the keys of a run with their values. `GROUP=OPTION`
chooses the file `conf/GROUP/OPTION.yaml`; a path changes one key: `slam.em.noise=0.5`.
"""
NAMES = """# Python

What `import emgs_jax` provides in this version, by file. A class takes the fields listed with it as arguments.
[How it works](how_it_works.md#the-library-in-python) has an example.
"""


def keys() -> str:
    """Return the page in Markdown: a heading and the text of each YAML file, the commands' own files first."""
    paths = sorted(CONF.rglob("*.yaml"), key=lambda path: (len(path.parts), path))
    listings = (f"## {path.relative_to(CONF)}\n\n```yaml\n{path.read_text(encoding='utf-8')}```\n" for path in paths)
    return "\n".join([KEYS, *listings])


def names() -> str:
    """Return the page in Markdown: a heading for each file, below it what users import of it, without its bodies."""
    parts, tree = [NAMES], ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and f"{node.module}".startswith("emgs_jax."):
            path = ROOT / f"{node.module.replace('.', '/')}.py"
            parts.append(f"## {node.module}\n")
            parts += listings(path, {alias.name: alias.asname or alias.name for alias in node.names})
    return "\n".join(parts)


def listings(path: Path, wanted: dict[str, str]) -> Iterator[str]:
    """Yield what a file defines of these names: a heading, and the definition without the bodies of functions."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name in wanted:
            yield f"### {wanted[node.name]}\n\n```python\n{ast.unparse(outline(node))}\n```\n"


def outline(node: ast.FunctionDef | ast.ClassDef) -> ast.stmt:
    """Keep the docstring, and of a class its fields and the outlines of its public methods."""
    text = [ast.Expr(ast.Constant(ast.get_docstring(node) or ...))]
    if isinstance(node, ast.ClassDef):
        text += [part for part in node.body if isinstance(part, ast.AnnAssign)]
        methods = (part for part in node.body if isinstance(part, ast.FunctionDef))
        text += [outline(part) for part in methods if not part.name.startswith("_")]
    node.body = text
    return node


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages to the site as `every_key.md` and `names.md`, and CHANGELOG.md as `changes.md`."""
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    for name, page in (("every_key.md", keys()), ("names.md", names()), ("changes.md", changes)):
        files.append(File.generated(config, name, content=page))
    return files

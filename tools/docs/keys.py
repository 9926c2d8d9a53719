"""Hook of mkdocs: a page of every key, its default and its comment, made of the files in `conf/`."""

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

CONF = Path(__file__).parents[2] / "conf"
HEAD = """# Keys

Every file of `conf/`, as it is in this version. `emgs run --cfg job` prints the keys of a run with their values.
A file `conf/GROUP/OPTION.yaml` is chosen with `GROUP=OPTION`; a key is changed with its path, `slam.em.noise=0.5`.
"""


def page(conf: Path = CONF) -> str:
    """Return the page in Markdown: a heading and the text of each YAML file, the commands' own files first."""
    paths = sorted(conf.rglob("*.yaml"), key=lambda path: (len(path.parts), path))
    listings = (f"## {path.relative_to(conf)}\n\n```yaml\n{path.read_text(encoding='utf-8')}```\n" for path in paths)
    return "\n".join([HEAD, *listings])


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the page to the site as `keys.md`."""
    files.append(File.generated(config, "keys.md", content=page()))
    return files

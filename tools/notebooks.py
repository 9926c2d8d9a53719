"""`python -m tools.notebooks 01 02` (all without words): run notebooks in new folders and keep what they show.

Pictures get a palette and at most MAX_WIDTH pixels, pages that are long and progress bars go. The digest of the code
stands beside the outputs, so that the tests see when they are of other code. Needs nbclient and ipykernel.
"""

import base64
import hashlib
import io
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
MAX_WIDTH, NUM_COLORS = 900, 64
MAX_PAGE = 10_000  # characters
OUTPUTS_OF = "outputs_of"  # the key of the digest in a notebook's metadata


def code_digest(cells: list[dict[str, Any]]) -> str:
    """Hex digest of the code cells, in order."""
    texts = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:16]


def small(png: str) -> str:
    """A picture, base64, with a palette and at most MAX_WIDTH pixels wide."""
    image = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
    image.thumbnail((MAX_WIDTH, MAX_WIDTH), Image.Resampling.LANCZOS)
    file = io.BytesIO()
    image.quantize(NUM_COLORS).save(file, "PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode()


def kept(outputs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What a cell shows without its progress bars and long pages."""
    found = [output for output in outputs if output.get("name") != "stderr"]
    for data in (output.get("data", {}) for output in found):
        if "image/png" in data:
            data["image/png"] = small(data["image/png"])
        if len("".join(data.get("text/html", ""))) > MAX_PAGE:
            del data["text/html"]
    return found


def execute(path: Path) -> None:
    """Run a notebook in a new folder and write it back with its outputs; an error in a cell is raised."""
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(notebook, timeout=None, resources={"metadata": {"path": folder}}).execute()
    values = json.loads(nbformat.writes(notebook))
    metadata = {"kernelspec": values["metadata"]["kernelspec"], "language_info": {"name": "python"}}
    values["metadata"] = metadata | {OUTPUTS_OF: code_digest(values["cells"])}
    for cell in values["cells"]:
        cell["metadata"] = {}
        if cell["cell_type"] == "code":
            cell["outputs"] = kept(cell["outputs"])
    path.write_text(json.dumps(values, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        if path.name.startswith(tuple(sys.argv[1:] or [""])):
            execute(path)

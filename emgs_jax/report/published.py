"""Published numbers, to show beside ours."""

from pathlib import Path
from typing import Any

import yaml


def published(table: str) -> list[dict[str, Any]]:
    """Read published.yaml: rows of `reconstruction` (Table II, the peers' own papers) or `segmentation` (Table III)."""
    text = Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8")
    return yaml.safe_load(text)[table]

"""Numbers that papers print, beside which tables show ours."""

from pathlib import Path
from typing import Any

import yaml


def published(table: str) -> list[dict[str, Any]]:
    """Rows of `reconstruction` (Table II and the peers' own papers) or `segmentation` (Table III): published.yaml."""
    text = Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8")
    return yaml.safe_load(text)[table]

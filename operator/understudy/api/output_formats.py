"""Machine-readable output of commands: plain values as JSON or YAML."""

from __future__ import annotations

import json
from typing import Any

import yaml


def structured(value: Any, form: str) -> str:
    """Return plain values as ``json`` or ``yaml``, without a newline at the end."""
    return json.dumps(value, indent=2) if form == "json" else yaml.safe_dump(value, sort_keys=False).rstrip()

"""Machine-readable output of commands: plain values as JSON or YAML."""

from __future__ import annotations

import json
from typing import Any

import yaml


def structured(told: Any, form: str) -> str:
    """Return plain values as ``json`` or ``yaml``, without a newline at the end."""
    return json.dumps(told, indent=2) if form == "json" else yaml.safe_dump(told, sort_keys=False).rstrip()

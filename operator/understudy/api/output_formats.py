"""What a command prints for programs: plain values as JSON or as YAML."""

from __future__ import annotations

import json
from typing import Any

import yaml


def structured(told: Any, form: str) -> str:
    """Plain values as ``json`` or ``yaml``, without a newline at the end."""
    return json.dumps(told, indent=2) if form == "json" else yaml.safe_dump(told, sort_keys=False).rstrip()

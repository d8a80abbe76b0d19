"""The values that everybody has to give the chart."""

from __future__ import annotations

IMAGES = {"operator": {"repository": "understudy/operator"}, "monitor": {"repository": "understudy/monitor"}}
"""Images that nobody pulls."""

SET_IMAGES = ",".join(f"images.{name}.repository={image['repository']}" for name, image in IMAGES.items())
"""The same, for ``--set``."""

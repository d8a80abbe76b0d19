"""What ``scripts/generate`` writes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from scripts.generation import commands, diagrams, leaves, metrics, precedence, reference, scenarios, values
from understudy.api.schema.definitions import definitions

CHART = Path("charts/understudy")
REFERENCE = Path("docs/reference")
IMAGES = Path("docs/images")
SCENARIOS = Path("docs/trees-osc.md")
PROCEDURES = Path("docs/procedures.md")
LIMITS = Path("docs/limits.md")
TREES = Path("docs/trees.md")
LIBRARY = Path("operator/understudy/trees/languages/osc/lib_osc/understudy.osc")


class _Dumper(yaml.SafeDumper):
    """YAML as people write it: no anchors, lists indented under their key."""

    def ignore_aliases(self, data: Any) -> bool:
        """Never write an anchor."""
        return True

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        """Indent lists too."""
        super().increase_indent(flow, False)


def to_yaml(data: Mapping[str, Any]) -> str:
    """Data as YAML, in its own order."""
    return yaml.dump(dict(data), Dumper=_Dumper, sort_keys=False, width=120)


def outputs(root: Path) -> dict[Path, str]:
    """The text of every generated file by its path in the project.

    ``root`` is where the hand-written parts are read from: the chart's values, its README around the table, and what pages say of leaves.
    """
    header = "# Written by scripts/generate from the models in operator/understudy/api: change those.\n"
    result: dict[Path, str] = {}
    for name, definition in definitions().items():
        text = header + to_yaml(definition)
        result[Path("crds") / name] = text
        result[CHART / "files" / "crds" / name] = text
    described = (root / TREES).read_text(), (root / PROCEDURES).read_text()
    result[REFERENCE / "api.md"] = reference.page()
    result[REFERENCE / "leaves.md"] = leaves.page(*described)
    result[REFERENCE / "cli.md"] = commands.page()
    result[REFERENCE / "metrics.md"] = metrics.page()
    result[IMAGES / "architecture.svg"] = diagrams.architecture()
    result[IMAGES / "failover-steps.svg"] = diagrams.failover()
    result[LIBRARY] = scenarios.library(*described)
    readme = CHART / "README.md"
    table = values.table((root / CHART / "values.yaml").read_text())
    result[readme] = values.between_markers((root / readme).read_text(), table)
    result[SCENARIOS] = values.between_markers(
        (root / SCENARIOS).read_text(), scenarios.table(), scenarios.BEGIN, scenarios.END
    )
    result[PROCEDURES] = values.between_markers(
        (root / PROCEDURES).read_text(), scenarios.languages(), scenarios.PROCEDURES_BEGIN, scenarios.PROCEDURES_END
    )
    result[LIMITS] = values.between_markers(
        (root / LIMITS).read_text(), precedence.table(), precedence.BEGIN, precedence.END
    )
    return result

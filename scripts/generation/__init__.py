"""Builds everything that ``scripts/generate`` writes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from scripts.generation import (
    commands,
    diagrams,
    figures,
    leaves,
    metrics,
    networks,
    precedence,
    reference,
    scenarios,
    tables,
    tested,
    values,
)
from understudy.api.schema.definitions import definitions

CHART = Path("charts/understudy")
REFERENCE = Path("docs/reference")
IMAGES = Path("docs/images")
SCENARIOS = Path("docs/trees-osc.md")
PROCEDURES = Path("docs/procedures.md")
LIMITS = Path("docs/limits.md")
TREES = Path("docs/trees.md")
README = Path("README.md")
NETWORKS = Path("docs/how-to/network-policies.md")
LIBRARY = Path("operator/understudy/trees/languages/osc/lib_osc/understudy.osc")


class _Dumper(yaml.SafeDumper):
    """Writes YAML as people do: without anchors, and with lists indented below their key."""

    def ignore_aliases(self, data: Any) -> bool:
        """Never write an anchor."""
        return True

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        """Indent lists too."""
        super().increase_indent(flow, False)


def to_yaml(data: Mapping[str, Any]) -> str:
    """Return data as YAML, in its own order."""
    return yaml.dump(dict(data), Dumper=_Dumper, sort_keys=False, width=120)


def outputs(root: Path) -> dict[Path, str]:
    """Return the text of every generated file by its path in the project.

    ``root`` is the folder with what is read: the chart's values, the pages around tables and figures, the results of benches,
    and the end-to-end tests.
    """
    header = "# Written by scripts/generate from the models in operator/understudy/api: change those.\n"
    result: dict[Path, str] = {}
    for name, definition in definitions().items():
        text = header + to_yaml(definition)
        result[Path("crds") / name] = text
        result[CHART / "files" / "crds" / name] = text
    result[REFERENCE / "api.md"] = reference.page()
    result[REFERENCE / "leaves.md"] = leaves.page()
    result[REFERENCE / "cli.md"] = commands.page()
    result[REFERENCE / "metrics.md"] = metrics.page()
    result[REFERENCE / "tested.md"] = tested.page(root)
    result[IMAGES / "architecture.svg"] = diagrams.architecture()
    result[IMAGES / "failover-steps.svg"] = diagrams.failover()
    result[IMAGES / "pipeline.svg"] = diagrams.pipeline()
    result[LIBRARY] = scenarios.library()
    readme = CHART / "README.md"
    table = values.table((root / CHART / "values.yaml").read_text())
    result[readme] = values.between_markers((root / readme).read_text(), table)
    result[SCENARIOS] = values.between_markers(
        (root / SCENARIOS).read_text(), scenarios.table(), scenarios.BEGIN, scenarios.END
    )
    result[LIMITS] = values.between_markers(
        (root / LIMITS).read_text(), precedence.table(), precedence.BEGIN, precedence.END
    )
    results = root / figures.RESULTS
    for page, parts in {
        README: ((networks.summary(results), networks.SUMMARY_BEGIN, networks.SUMMARY_END),),
        NETWORKS: (
            (networks.table(results), networks.BEGIN, networks.END),
            (networks.handovers(results), networks.HANDOVERS_BEGIN, networks.HANDOVERS_END),
        ),
        TREES: (
            (scenarios.leaf_table(), scenarios.LEAVES_BEGIN, scenarios.LEAVES_END),
            (scenarios.tag_table(), scenarios.TAGS_BEGIN, scenarios.TAGS_END),
            (scenarios.health_models(), scenarios.MODELS_BEGIN, scenarios.MODELS_END),
        ),
        PROCEDURES: (
            (scenarios.languages(), scenarios.PROCEDURES_BEGIN, scenarios.PROCEDURES_END),
            (scenarios.step_models(), scenarios.MODELS_BEGIN, scenarios.MODELS_END),
        ),
    }.items():
        result[page] = (root / page).read_text()
        for text, begin, end in parts:
            result[page] = values.between_markers(result[page], text, begin, end)
    for page in figures.pages(root):
        text = result[page] if page in result else (root / page).read_text()
        try:
            result[page] = figures.in_sentences(tables.in_page(text, results), results)
        except ValueError as error:
            raise ValueError(f"{page}: {error}") from None
    return result

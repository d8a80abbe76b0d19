"""Health trees that policies take from ConfigMaps, where those are among the files."""

from __future__ import annotations

import pytest

from tests.support.golden import assert_golden
from tests.unit.cli.check.manifests import POLICY, checked, found, only

REFERRING = POLICY.replace(
    "yaml: {topic: {name: /cmd_vel, gap: 500ms}}", "configMapKeyRef: {name: trees, key: health.yaml}"
)
TREES = """\
apiVersion: v1
kind: ConfigMap
metadata: {name: trees, labels: {understudy.dev/health-tree: "true"}}
data:
  health.yaml: |
    # what drives the robot
    topic:
      name: /cmd_vel
      gap: 500ms
"""


def test_a_valid_tree_has_no_findings() -> None:
    assert found(REFERRING, TREES) == []
    assert checked(REFERRING, TREES).skipped == 1


def test_a_config_map_missing_from_the_files_is_reported() -> None:
    finding = only(REFERRING)
    assert (finding.severity, finding.field) == ("warning", "spec.monitoring.configMapKeyRef.name")
    assert tuple(finding.place) == (6, 23)


def test_a_problem_is_reported_at_its_place_in_the_file() -> None:
    finding = only(REFERRING, TREES.replace("500ms", "500 parsecs"))
    assert_golden(
        "check", str(finding), "b.yaml:9:7: error", "ConfigMap", "data.health.yaml", "topic.gap", "'500 parsecs'"
    )


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        (TREES.replace(', labels: {understudy.dev/health-tree: "true"}', ""), "b.yaml:3:1:", "requires the label"),
        (TREES.replace("health.yaml", "healthy.yaml"), "a.yaml:6:36", 'did you mean "healthy.yaml"?'),
    ],
)
def test_an_unreadable_tree_is_reported(text: str, place: str, words: str) -> None:
    finding = only(REFERRING, text)
    assert finding.severity == "error"
    assert str(finding).startswith(place)
    assert words in finding.message


def test_a_key_without_a_format_suffix_is_refused() -> None:
    finding = only(REFERRING.replace("health.yaml", "health"), TREES)
    assert (finding.severity, finding.field) == ("error", "spec.monitoring.configMapKeyRef.key")
    assert '"health": the suffix of the key must be' in finding.message

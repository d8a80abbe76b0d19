"""Manifests as files have them, and what checking them finds."""

from __future__ import annotations

import textwrap

from understudy.cli.check.command import Result, check
from understudy.cli.manifests.check_findings import Finding

POLICY = """\
apiVersion: understudy.dev/v1alpha1
kind: FailurePolicy
metadata: {name: navigation}
spec:
  monitoring:
    yaml: {topic: {name: /cmd_vel, gap: 500ms}}
  strategies:
    - {type: Restart}
"""

WORKLOAD = """\
apiVersion: understudy.dev/v1alpha1
kind: RobotWorkload
metadata: {name: robot-17, labels: {app: navigation}}
spec:
  workloadRef: {kind: Deployment, name: nav2}
  outputs:
    - {topic: /cmd_vel, type: geometry_msgs/msg/Twist}
  failurePolicyRef: {name: navigation}
"""

POOL = """\
apiVersion: understudy.dev/v1alpha1
kind: FallbackPool
metadata: {name: hot}
spec:
  readiness: Executing
  perWorkload: 1
  workloadSelector: {matchLabels: {app: navigation}}
"""


def workload(name: str) -> str:
    """Another workload, with pods of its own."""
    return WORKLOAD.replace("robot-17", name).replace("nav2", f"nav2-{name}")


def checked(*texts: str) -> Result:
    """The result for files a.yaml, b.yaml and so on."""
    return check([(f"{chr(ord('a') + index)}.yaml", text.encode()) for index, text in enumerate(texts)])


def found(*texts: str) -> list[Finding]:
    """The findings in these files."""
    return checked(*texts).findings


def only(*texts: str) -> Finding:
    """The one finding in these files."""
    (finding,) = found(*texts)
    return finding


def text(indented: str) -> str:
    """A manifest without the indentation that it has in a test."""
    return textwrap.dedent(indented).lstrip("\n")

"""``understudy doctor`` finds what the chart installs, and asks for no right that the chart doesn't give."""

from __future__ import annotations

from tests.unit.chart.conftest import Render, one
from understudy import __version__
from understudy.cli.doctor import installation_check, rights_check
from understudy.cli.doctor.installation_check import Installed


def test_doctor_finds_the_deployment_of_the_chart_and_reads_its_settings(render: Render) -> None:
    found = Installed(one(render("images.monitorPullSecrets[0].name=key"), "Deployment"))
    labels = found.item["metadata"]["labels"]
    assert all(
        labels[key] == value
        for key, _, value in (term.partition("=") for term in installation_check.SELECTOR.split(","))
    )
    assert found.version == __version__
    assert found.account == "system:serviceaccount:system:understudy-operator"
    assert found.images is not None
    assert found.images.monitor.endswith(f":{__version__}")
    assert found.images.pull_secrets == ("key",)


def test_doctor_requires_only_rights_that_the_chart_grants(render: Render) -> None:
    rules = one(render(), "ClusterRole", "understudy-operator")["rules"]
    granted = {
        (group, resource, verb)
        for rule in rules
        for group in rule["apiGroups"]
        for resource in rule["resources"]
        for verb in rule["verbs"]
    }
    assert {(right.group, right.resource, right.verb) for right in rights_check.operators()} <= granted

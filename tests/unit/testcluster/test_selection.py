"""The provider of a cluster, and its network, are those that were asked for."""

from __future__ import annotations

import pytest

from testcluster import cli
from testcluster.local.cilium_enforcer import SETTINGS, Cilium, version
from testcluster.local.layout import BadSetting, Layout, decide
from testcluster.progress import Progress
from testcluster.providers.base import ClusterError


@pytest.mark.parametrize(
    ("provider", "network", "message"),
    [
        ("local", "calico", "network 'calico': own or cilium is needed"),
        ("kind", "cilium", "provider kind: its network cannot be chosen"),
        ("current", "cilium", "provider current: its network cannot be chosen"),
    ],
)
def test_a_network_that_a_provider_does_not_have_is_refused(provider: str, network: str, message: str) -> None:
    with pytest.raises(ClusterError, match=message):
        cli.select(provider, None, Progress(), network)


@pytest.mark.parametrize("name", ["knd", "Kind"])
def test_a_provider_that_does_not_exist_is_not_taken_for_the_current_cluster(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    # argparse does not check a default, and this is one.
    monkeypatch.setenv("UNDERSTUDY_CLUSTER_PROVIDER", name)
    assert cli.main(["down"]) == 1
    assert f"provider {name!r}: kind, local or current is needed" in capsys.readouterr().err


@pytest.fixture
def one(monkeypatch: pytest.MonkeyPatch, tmp_path: object) -> Layout:
    """A cluster with one node that was never started."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("UNDERSTUDY_CLUSTER_NODES", "1")
    monkeypatch.delenv("UNDERSTUDY_CLUSTER_ADDRESSES", raising=False)
    return decide("one", Cilium.name)


def test_settings_of_the_environment_replace_those_of_a_cilium_agent(
    monkeypatch: pytest.MonkeyPatch, one: Layout
) -> None:
    etc = one.node_state(1) / "etc"
    (etc / "cni").mkdir(parents=True)
    (etc / "cni" / "05-cilium.conflist").write_text("of an earlier start")
    monkeypatch.setenv(SETTINGS, '{"enable-policy": "always", "policy-cidr-match-mode": "nodes"}')
    Cilium(one.state).configure(one, 1)
    settings = {path.name: path.read_text() for path in (etc / "cilium").iterdir()}
    assert settings["enable-policy"] == "always"
    assert settings["policy-cidr-match-mode"] == "nodes"
    assert settings["ipv4-native-routing-cidr"] == str(one.pods)
    assert not (etc / "cni" / "05-cilium.conflist").exists(), "the node is not Ready before its agent"


@pytest.mark.parametrize("text", ["{", "[]", '"a"'])
def test_settings_that_are_no_mapping_are_refused_with_the_name_of_the_variable(
    monkeypatch: pytest.MonkeyPatch, one: Layout, text: str
) -> None:
    (one.node_state(1) / "etc" / "cni").mkdir(parents=True)
    monkeypatch.setenv(SETTINGS, text)
    with pytest.raises(BadSetting, match=SETTINGS):
        Cilium(one.state).configure(one, 1)


def test_the_version_of_cilium_is_that_of_its_module() -> None:
    assert version().count(".") == 2

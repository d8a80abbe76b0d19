"""A machine with stand-ins for kind and Docker."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.fake_kind import FakeKind
from tests.unit.testcluster.kind_commands import kubeconfig


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeKind:
    """A machine with kind and Docker, without a cluster. There are no other programs in PATH."""
    programs = tmp_path / "bin"
    programs.mkdir()
    monkeypatch.setenv("PATH", str(programs))
    monkeypatch.setattr("testcluster.packages.SBIN", str(programs))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for variable in ("PROVIDER", "NAME", "NETWORK"):
        monkeypatch.delenv(f"UNDERSTUDY_CLUSTER_{variable}", raising=False)
    return FakeKind(programs)


@pytest.fixture
def cluster(machine: FakeKind, tmp_path: Path) -> FakeKind:
    """The same with a cluster of kind."""
    configuration = tmp_path / "configuration.yaml"
    configuration.write_text("nodes:\n- role: control-plane\n" + "- role: worker\n" * 3)
    machine.create_cluster("understudy", configuration, kubeconfig())
    return machine

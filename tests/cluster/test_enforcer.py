"""The local provider's enforcer of NetworkPolicies: its own tests, in Go, with real packets."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.mark.local_only
@pytest.mark.long  # what it enforces on the cluster is tested by the tables of test_network_policy
@pytest.mark.timeout(900)
def test_the_enforcer_s_own_tests_pass() -> None:
    script = REPOSITORY / "testcluster" / "local" / "netpol" / "test.sh"
    done = subprocess.run([str(script)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert done.returncode == 0, done.stdout

"""Modes of a node's network: how they are written, read and named."""

from __future__ import annotations

import json

import pytest

from testcluster.modes import NetworkModes


def test_modes_are_read_as_they_were_written() -> None:
    modes = NetworkModes(established=True, deaf=True, lag=250, keep_vanished=True, label_lag=1.5)
    assert NetworkModes.from_json(modes.to_json()) == modes


def test_the_file_has_the_keys_of_the_enforcer() -> None:
    assert json.loads(NetworkModes(lag=250).to_json()) == {
        "established": False,
        "deaf": False,
        "lagMilliseconds": 250,
        "keepVanished": False,
        "labelLagSeconds": 0.0,
    }


def test_a_lag_is_never_negative() -> None:
    for wrong in ({"lag": -1}, {"label_lag": -0.5}):
        with pytest.raises(ValueError, match="negative"):
            NetworkModes(**wrong)  # type: ignore[arg-type]


def test_modes_are_named_for_the_status_of_a_cluster() -> None:
    assert str(NetworkModes()) == "none"
    assert str(NetworkModes(deaf=True, lag=250)) == "deaf, lag 250 ms"

"""How often a test on a cluster is run again after a failure."""

from __future__ import annotations

import pytest


def once_more(config: pytest.Config, **more: object) -> pytest.MarkDecorator:
    """Return the mark of a test that is run once more if it fails, or as often as ``--reruns`` says.

    A mark takes precedence over the option, so it has to contain the option's value.
    """
    given = config.getoption("reruns", None)
    return pytest.mark.flaky(reruns=1 if given is None else given, **more)

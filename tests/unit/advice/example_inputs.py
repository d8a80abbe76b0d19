"""Hypothesis strategies for requirements, pools and figures."""

from __future__ import annotations

from typing import get_args

from hypothesis import strategies as st

from understudy.advice.strategy_figures import Figure, Figures, Way
from understudy.advice.strategy_order import Candidate
from understudy.api.kinds.requirements_spec import Level, Requirements

LEVELS: tuple[Level, ...] = get_args(Level)
WAYS: tuple[Way, ...] = ("Executing", "Initialized", "Uninitialized", "Restart")

levels = st.sampled_from(LEVELS)
requirements = st.builds(
    Requirements, safety=levels, availability=levels, resource_usage=levels, task_criticality=levels
)
pools = st.lists(
    st.builds(
        Candidate,
        way=st.sampled_from(WAYS[:3]),
        pool=st.sampled_from(["a", "b", "c", "d", "e"]),
        # Many pools are alike: an order is least stable if only the names differ.
        standbys=st.sampled_from([0.1, 0.5, 1.0, 2.0]),
    ),
    max_size=5,
    unique_by=lambda one: one.pool,
)
_values = st.sampled_from([0.0, 0.05, 0.1, 0.5, 0.83, 2.0, 4.0]) | st.floats(0, 100)
_measured = st.dictionaries(st.sampled_from(WAYS), st.builds(Figure, value=_values, source=st.just("measured")))
figures = st.builds(Figures, measured_seconds=_measured, measured_cpu=_measured)

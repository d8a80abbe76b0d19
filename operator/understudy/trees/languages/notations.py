"""Loads health trees in all of their notations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from understudy.api.durations import seconds
from understudy.trees.core.health_tree import HealthTree
from understudy.trees.languages.btcpp import library as xml
from understudy.trees.languages.btcpp import loader as btcpp
from understudy.trees.languages.osc import dialects as scenarios
from understudy.trees.languages.osc import loader as osc
from understudy.trees.languages.short.health_loader import load
from understudy.trees.languages.text.loader import load_translated
from understudy.trees.languages.text.source_map import SourceMap
from understudy.trees.source.expressions import Fields
from understudy.trees.source.positions import WHOLE_FILE, TextOffset
from understudy.trees.source.problems import Problem, TreeError, did_you_mean

if TYPE_CHECKING:  # agents do not need it, and must start quickly
    from understudy.api.kinds.failure_policy import Monitoring
    from understudy.api.kinds.tree_spec import Written

_LANGUAGES = {"xml": (btcpp.reader(xml.HEALTH), btcpp.CALLED), "osc": (osc.reader(scenarios.HEALTH), osc.CALLED)}

FORMS = ("yaml", *_LANGUAGES)
"""All notations. Each is the field of ``spec.monitoring`` that holds such a tree."""

TEXTS = tuple(_LANGUAGES)
"""The notations that are texts, with lines and columns of their own."""


def load_health(
    form: str,
    tree: Any,
    *,
    grace: float,
    fields: Fields | None = None,
    path: str | None = None,
    begins: TextOffset = WHOLE_FILE,
) -> HealthTree:
    """Load a health tree in the notation ``form``, which is its field in ``spec.monitoring``.

    ``grace`` is in seconds; ``path`` names the place in problems if it is not that field. Conditions over messages are
    checked with the ``fields`` of their types, if these are known. The lines and columns of problems with a text are
    those of the file in which it ``begins``.

    Raises TreeError with all problems.
    """
    if form not in FORMS:
        raise TreeError([Problem("form", f"found {form!r:.60}{did_you_mean(str(form), FORMS)}")])
    path = path or f"spec.monitoring.{form}"
    if form not in TEXTS:
        return load(tree, path=path, grace=grace, fields=fields)

    def loaded(node: dict[str, Any], source: SourceMap) -> HealthTree:
        return load(node, path=path, grace=grace, fields=fields, called=source.called)

    read, called = _LANGUAGES[form]
    return load_translated(tree, read, loaded, called=called, path=path, begins=begins)


def load_monitoring(monitoring: Monitoring, *, fields: Fields | None = None) -> HealthTree:
    """Load the health tree of a policy; ``fields`` as in :func:`load_health`. Raises TreeError with all problems."""
    return load_health(monitoring.form, monitoring.tree, grace=seconds(monitoring.startup_grace), fields=fields)


def load_inline(tree: Written, *, path: str, grace: float, fields: Fields | None = None) -> HealthTree:
    """Load the tree at ``path``, such as ``spec.degraded.monitoring``; ``grace`` and ``fields`` as in
    :func:`load_health`.

    Raises TreeError with all problems.
    """
    return load_health(tree.form, tree.tree, grace=grace, fields=fields, path=f"{path}.{tree.form}")

"""Loads health trees in all of their notations."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from understudy.api.durations import seconds
from understudy.trees.core.health_tree import HealthTree
from understudy.trees.languages.btcpp.loader import load_xml
from understudy.trees.languages.osc.loader import load_osc
from understudy.trees.languages.short.health_loader import load
from understudy.trees.source.expressions import Fields
from understudy.trees.source.positions import WHOLE_FILE, TextOffset
from understudy.trees.source.problems import Problem, TreeError, did_you_mean

if TYPE_CHECKING:  # agents do not need it, and must start quickly
    from understudy.api.kinds.failure_policy import Monitoring
    from understudy.api.kinds.tree_spec import Written

_LOADERS: dict[str, Callable[..., HealthTree]] = {"yaml": load, "xml": load_xml, "osc": load_osc}

FORMS = tuple(_LOADERS)
"""All notations. Each is the field of ``spec.monitoring`` that holds such a tree."""

TEXTS = ("xml", "osc")
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
    if form not in _LOADERS:
        raise TreeError([Problem("form", f"found {form!r:.60}{did_you_mean(str(form), _LOADERS)}")])
    placed = {"begins": begins} if form in TEXTS else {}
    return _LOADERS[form](tree, path=path or f"spec.monitoring.{form}", grace=grace, fields=fields, **placed)


def load_monitoring(monitoring: Monitoring, *, fields: Fields | None = None) -> HealthTree:
    """Load the health tree of a policy; ``fields`` as in :func:`load_health`. Raises TreeError with all problems."""
    return load_health(monitoring.form, monitoring.tree, grace=seconds(monitoring.startup_grace), fields=fields)


def load_inline(tree: Written, *, path: str, grace: float, fields: Fields | None = None) -> HealthTree:
    """Load the tree at ``path``, such as ``spec.degraded.monitoring``; ``grace`` and ``fields`` as in
    :func:`load_health`.

    Raises TreeError with all problems.
    """
    return load_health(tree.form, tree.tree, grace=grace, fields=fields, path=f"{path}.{tree.form}")

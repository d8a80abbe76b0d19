"""The forms that a health tree can be written in, all loaded in this one place."""

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

if TYPE_CHECKING:  # an agent has no use for it, and is to be there soon
    from understudy.api.kinds.failure_policy import Monitoring
    from understudy.api.kinds.tree_spec import Written

_LOADERS: dict[str, Callable[..., HealthTree]] = {"yaml": load, "xml": load_xml, "osc": load_osc}

FORMS = tuple(_LOADERS)
"""All forms, each the field of ``spec.monitoring`` that a tree of it stands in."""

TEXTS = ("xml", "osc")
"""The forms that are texts, with lines and columns of their own."""


def load_health(
    form: str,
    tree: Any,
    *,
    grace: float,
    fields: Fields | None = None,
    path: str | None = None,
    begins: TextOffset = WHOLE_FILE,
) -> HealthTree:
    """A health tree of a form, which is the field of ``spec.monitoring`` that it stands in. ``grace`` in seconds; ``path``
    names the place in problems if it is not the field.
    Conditions over messages are checked by their types' ``fields``, if these are known. The lines and columns of
    problems with a text are those of the file in which it ``begins``.

    Raises TreeError with all problems.
    """
    if form not in _LOADERS:
        raise TreeError([Problem("form", f"found {form!r:.60}{did_you_mean(str(form), _LOADERS)}")])
    placed = {"begins": begins} if form in TEXTS else {}
    return _LOADERS[form](tree, path=path or f"spec.monitoring.{form}", grace=grace, fields=fields, **placed)


def load_monitoring(monitoring: Monitoring, *, fields: Fields | None = None) -> HealthTree:
    """The health tree of a policy; ``fields`` as of :func:`load_health`. Raises TreeError with all problems."""
    return load_health(monitoring.form, monitoring.tree, grace=seconds(monitoring.startup_grace), fields=fields)


def load_inline(tree: Written, *, path: str, grace: float, fields: Fields | None = None) -> HealthTree:
    """A tree that stands at ``path``, such as ``spec.degraded.monitoring``; ``grace`` and ``fields`` as of :func:`load_health`.

    Raises TreeError with all problems.
    """
    return load_health(tree.form, tree.tree, grace=grace, fields=fields, path=f"{path}.{tree.form}")

"""The actions and modifiers that only procedures and checks in OpenSCENARIO 2 have, derived from the short form."""

from __future__ import annotations

from collections.abc import Mapping

from understudy.trees.languages.osc import tokens
from understudy.trees.languages.osc.dialects import Dialect
from understudy.trees.languages.osc.library import ACTIONS, MODIFIERS, STATUS_CHANGES, Argument, Behavior, behavior_of
from understudy.trees.languages.short.procedure_loader import HEALTH
from understudy.trees.languages.text import step_values
from understudy.trees.leaves import procedure_leaves
from understudy.trees.leaves.registry import REFUSED_PLUGINS
from understudy.trees.source import tree_kinds

STEPS: Mapping[str, Behavior] = {
    kind: behavior_of(kind, step.arguments, step_values.READS) for kind, step in procedure_leaves.STEPS.items()
}
"""The steps of procedures as actions, by name."""

CONDITIONS: Mapping[str, Behavior] = {
    kind: behavior_of(kind, step.arguments, step_values.READS) for kind, step in procedure_leaves.CONDITIONS.items()
}
"""The conditions that procedures and checks evaluate once, by name."""

WATCHED: Mapping[str, Behavior] = {name: action for name, action in ACTIONS.items() if action.key in HEALTH}
"""Leaves of health trees that procedures and checks have too."""

DECORATORS: Mapping[str, Behavior] = {
    "timeout": Behavior("timeout", {"duration": Argument("duration", "time", "timeout.within")}),
    "retry": Behavior(
        "retry",
        {
            "count": Argument("count", "int", "retry.times", step_values.whole_of),
            "pause": Argument("pause", "time", "retry.wait"),
        },
    ),
}
"""The modifiers for the ``with:`` of a node of a procedure, by name: those of scenario-execution, except for the
pause."""

INVERTER: Mapping[str, Behavior] = {"inverter": MODIFIERS["inverter"]}
"""The modifier that checks have too."""

_ONCE = "a procedure is run once; write retry() for what may have to be tried again"
_STORE = "a procedure remembers and writes nothing; remove it"
_CERTAIN = "it does nothing to the instance; remove it"
_NO_PROCESSES = "no processes are started and no files read; write what is done to the instance, such as call_service()"
_DRIVING = "it judges the active instance only, and this one is not active yet; remove it"
_CLUSTER = "the strategies of a policy say what is done in the cluster; remove it"

_OTHERS: Mapping[str, str] = {
    **REFUSED_PLUGINS,
    **dict.fromkeys((name for name in ACTIONS if name not in WATCHED), _DRIVING),
    "while_task_active": "a procedure is run whatever the robot works on; remove it",
    **dict.fromkeys(("run_process", "process_log_check"), _NO_PROCESSES),
    **dict.fromkeys(("increment", "decrement"), _STORE),
    "compare": "values of messages are compared by value(); write that",
    "repeat": _ONCE,
    **dict.fromkeys(STATUS_CHANGES, _CERTAIN),
    "action_call": "write resend_goals() for the goals that the robot had, or call_service()",
    "service_call": "write call_service()",
    "topic_publish": "write publish()",
    "set_node_parameter": "write set_parameters()",
    "topic_monitor": "write topic()",
    "assert_topic_latency": "write age()",
    "assert_lifecycle_state": "write lifecycle_is()",
    "wait_for_topics": "write wait_for()",
    **dict.fromkeys(("check_data", "wait_for_data"), "write value()"),
    **dict.fromkeys(("wait_for_nodes", "wait_for_node"), "write wait_for()"),
    **dict.fromkeys(("kubernetes_delete", "kubernetes_patch_network_policy"), _CLUSTER),
}

_KNOWN = {**STEPS, **CONDITIONS, **WATCHED, **DECORATORS, **INVERTER}
_REFUSED: Mapping[str, str] = {name: why for name, why in _OTHERS.items() if name not in _KNOWN}
_NO_ACTION = "a check takes no action; it belongs in a procedure"
_DONE = ("action_call", "service_call", "topic_publish", "set_node_parameter", "wait_for_topics")

PROCEDURES = Dialect(
    tree_kinds.PROCEDURE,
    {**STEPS, **CONDITIONS, **WATCHED},
    {**INVERTER, **DECORATORS},
    _REFUSED,
    tokens.REFUSED_IN_PROCEDURES,
    "bring_up",
    "do serial:",
    "set_lifecycle()",
)
"""Procedures."""

CHECKS = Dialect(
    tree_kinds.CHECK,
    {**CONDITIONS, **WATCHED},
    INVERTER,
    {
        **_REFUSED,
        **dict.fromkeys((*STEPS, *DECORATORS, *_DONE), _NO_ACTION),
        "repeat": "a check is evaluated in every period; remove it",
        "while_task_active": "an instance that waits has no task; remove it",
    },
    tokens.REFUSED_IN_CHECKS,
    "ready",
    "do parallel:",
    "lifecycle_is()",
)
"""Checks."""

"""Tells scenario-execution where our library is, through the entry point ``understudy`` of
``scenario_execution.osc_libraries``."""


def library() -> tuple[str, str]:
    """Return the package with the folder ``lib_osc``, and the file in that folder."""
    return "understudy.trees.languages.osc", "understudy.osc"

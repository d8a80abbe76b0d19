"""Where scenario-execution finds our library, under the entry point ``understudy`` of ``scenario_execution.osc_libraries``."""


def library() -> tuple[str, str]:
    """The package with the folder ``lib_osc``, and the file in there."""
    return "understudy.trees.languages.osc", "understudy.osc"

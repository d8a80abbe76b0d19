"""Processes of the navigation example, and of the manipulation example, which is built on it."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from tests.unit import processes

REPOSITORY = Path(__file__).parents[3]
SOURCES = (
    REPOSITORY / "operator",
    *(REPOSITORY / "examples" / name / "src" for name in ("navigation", "manipulation")),
)
SEED = 7


class Run(processes.Run):
    """Processes that all know the world of one seed."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        super().__init__(
            folder,
            stack,
            SOURCES,
            FASTDDS_BUILTIN_TRANSPORTS="UDPv4",
            NAVIGATION_SEED=str(SEED),
            NAVIGATION_CLIENT_LOG=str(folder / "client.jsonl"),
        )

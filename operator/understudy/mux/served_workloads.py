"""The workloads that a mux serves, by its environment: one, or one for each folder of files."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter

from understudy.api import names
from understudy.api.kinds.robot_workload import Output

CONTROL = "control.json"
"""The file that keeps whom the mux forwards, in the state folder, or in that of a workload there."""


@dataclass(frozen=True)
class Served:
    """A workload whose outputs the process forwards."""

    namespace: str
    name: str
    outputs: Sequence[Output]
    allowed: Collection[str]
    """The nodes that may write beside the mux."""
    token: bytes
    control: Path
    """The file that keeps whom the mux forwards."""


def served_workloads(environment: Mapping[str, str], state: Path) -> list[Served]:
    """Return the workloads that an environment names. Raises KeyError, ValueError and OSError."""
    if names.WORKLOAD_VARIABLE in environment:
        token = Path(environment.get(names.MUX_TOKEN_VARIABLE, names.MUX_TOKEN_FILE)).read_bytes()
        return [_served(environment, token, state / CONTROL)]
    found: list[Served] = []
    for folder in sorted(Path(environment.get(names.MUX_FOLDER_VARIABLE, names.MUX_FOLDER)).iterdir()):
        if not folder.is_dir() or folder.name.startswith("."):
            continue
        files = {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}
        if not (token := files.pop(names.TOKEN, b"")):
            raise ValueError(f"{folder} has no file {names.TOKEN}")
        texts = {name: text.decode() for name, text in files.items()}
        found.append(_served(texts, token, state / folder.name / CONTROL))
    if not found:
        raise ValueError("there is no folder of a workload")
    if len({(one.namespace, one.name) for one in found}) < len(found):
        raise ValueError("two folders are of the same workload")
    return found


def _served(texts: Mapping[str, str], token: bytes, control: Path) -> Served:
    return Served(
        texts[names.NAMESPACE_VARIABLE],
        texts[names.WORKLOAD_VARIABLE],
        TypeAdapter(list[Output]).validate_json(texts[names.OUTPUTS_VARIABLE]),
        TypeAdapter(list[str]).validate_json(texts.get(names.ALLOWED_NODES_VARIABLE, "[]")),
        token,
        control,
    )

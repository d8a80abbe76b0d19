"""``understudy prepare``: an init container that writes the DDS profiles of its pod before its processes read them.

It also creates the FIFOs that freeze containers. Only pods whose profiles need values that are not known before they
start have this container.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from understudy.agent.held_containers import make_fifo
from understudy.api import names
from understudy.api.protocol import freeze_script
from understudy.api.protocol.ownership_strength import strength
from understudy.process.file_replacement import replace_file


def main(argv: list[str]) -> int:
    """Fill in the mounted profiles and write them into the pod's shared volume."""
    if argv:
        print(f"understudy prepare: unexpected {' '.join(argv)}; it takes no arguments", file=sys.stderr)
        return 2
    source = Path(os.environ.get("UNDERSTUDY_PROFILES", f"{names.INSTANCE_PROFILES_DIR}/{names.PROFILES_KEY}"))
    try:
        write(
            source.read_text(),
            Path(os.environ.get("UNDERSTUDY_DIR", names.AGENT_DIR)),
            os.environ.get(names.POD_VARIABLE, ""),
        )
        directory = Path(os.environ.get("UNDERSTUDY_DIR", names.AGENT_DIR))
        for container in os.environ.get(names.FENCED_VARIABLE, "").split():
            make_fifo(directory / freeze_script.fence_name(container))
    except OSError as error:
        print(f"understudy prepare: {error}", file=sys.stderr)
        return 1
    return 0


def write(profiles: str, directory: Path, pod: str) -> Path:
    """Write the profiles of a pod and return the file. An existing file is not changed, since processes have read it.

    Raises OSError.
    """
    path = directory / names.PROFILES_KEY
    if not path.exists():
        # for all users: the application's processes have users of their own
        values = {names.POD_VARIABLE: pod, names.STRENGTH_VARIABLE: str(strength(time.time()))}
        replace_file(path, filled_in(profiles, values), mode=0o644)
    return path


def filled_in(text: str, values: Mapping[str, str]) -> str:
    """Return the text with ``${NAME}`` replaced for each given name. Other placeholders stay.

    Fast DDS replaces variables of a process's environment. A value that is not in the environment, or that must be the
    same for all processes of a pod, is filled in beforehand.
    """
    for name, value in values.items():
        text = text.replace(f"${{{name}}}", value)
    return text

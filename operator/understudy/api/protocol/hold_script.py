"""Makes a container of a held pod wait for its robot: a few lines of POSIX sh around the user's own command.

The user's image needs ``sh`` and no other binary. Agent and script communicate through a shared emptyDir, which the container cannot
write to: opening a FIFO for writing is allowed on a read-only mount. The script opens its
FIFO first and checks for the environment second; the agent writes the environment first and writes to the FIFO second. So neither
can miss the other. Nothing polls, and a held container uses no CPU.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence

from understudy.api import names

HOLD_SCRIPT = """\
understudy_env=$1/env-$2 understudy_wake=$1/wake-$2 understudy_file=$1/preloaded_interpreter.py understudy_preloading=$3
shift 3
trap 'exit 143' TERM INT
while [ "$1" != -- ]; do
  if [ ! -r "$understudy_env" ]; then
    nice -n 19 find -H "$1" -xdev -type f -exec cat {} + >/dev/null 2>&1 &
    wait "$!"
  fi
  shift
done
shift
if [ ! -r "$understudy_env" ]; then
  until [ -p "$understudy_wake" ]; do sleep 0.1; done
  if [ "$understudy_preloading" ] && [ -r "$understudy_file" ]; then exec $understudy_preloading "$@"; fi
  exec 3<>"$understudy_wake"
  until [ -r "$understudy_env" ]; do read -r understudy_line <&3 || sleep 1; done
  exec 3<&-
fi
. "$understudy_env"
exec "$@"
"""
"""Arguments: directory, container, what preloads modules or nothing, warm paths, ``--``, the command.

No ``$(`` and ``$$``: the kubelet expands those.

- PID 1 gets no signal that it doesn't trap, and a trap waits for a foreground child, so warming runs beside ``wait``.
- Warming is nice: other pods of the node drive robots. ``-xdev`` keeps it out of /proc. A missing path is no error.
- Opening the FIFO for reading and writing doesn't block and never sees the end of the file when the agent goes.
- The agent makes the FIFO. A container that starts before the agent looks for it ten times a second.
- The agent writes what preloads modules before it makes the FIFO. An earlier agent does not, and the container waits without.
- What preloads modules waits in place of the script, and opens the FIFO once it has them, so nobody takes the container for ready earlier.
- Once the environment is there, a restart of the container goes straight on to the command.
"""

PRELOADED_INTERPRETER = "preloaded_interpreter.py"
"""File that the agent writes, for the interpreter of the application."""

_INTERPRETER = re.compile(r"([-A-Za-z0-9_./]*/)?python(3(\.\d+)?)?")

_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def held_command(
    container: str,
    command: Sequence[str],
    args: Sequence[str],
    warm_paths: Sequence[str],
    *,
    preloading: str = "",
    directory: str = names.AGENT_DIR,
) -> list[str]:
    """Return the ``command`` (with no ``args``) with which a container waits for its robot and then runs the given command.

    ``preloading``: the result of :func:`preloading` for this command, if its interpreter is to import modules meanwhile.

    Raises ValueError if ``command`` is empty, because the image's entry point is unknown.
    """
    if not command:
        raise ValueError(
            f"container {container}: command is missing; a held container needs one, because the image's entry point is unknown"
        )
    script = ["/bin/sh", "-c", HOLD_SCRIPT, "understudy-hold"]
    return [*script, directory, container, preloading, *warm_paths, "--", *command, *args]


def preloads(command: Sequence[str]) -> bool:
    """Return whether modules can be preloaded for the command of an application: it begins with a Python interpreter."""
    return bool(command) and _INTERPRETER.fullmatch(command[0]) is not None


def preloading(
    container: str, command: Sequence[str], modules: Sequence[str], *, before: int, directory: str = names.AGENT_DIR
) -> str:
    """Return what a held container runs in place of the rest of the script: the words before the whole command.

    Args:
        command: that of the application, for which :func:`preloads` is true.
        before: how many words come before it in the whole command.
    """
    return f"{command[0]} {directory}/{PRELOADED_INTERPRETER} {directory} {container} {before} {','.join(modules)}"


def env_name(container: str) -> str:
    """File that the agent writes at the start: variables to add to the command's environment."""
    return f"env-{container}"


def wake_name(container: str) -> str:
    """FIFO; a line through it makes the script check for the environment. It has a reader only while the script waits."""
    return f"wake-{container}"


def waiting_name(container: str) -> str:
    """What agents up to 0.1.0 look for besides the reader of the FIFO."""
    return f"waiting-{container}"


def env_file(environment: Mapping[str, str]) -> str:
    """The environment as a file that ``sh`` sources. Values are taken literally, whatever is in them.

    Kubernetes allows variable names that no shell can export, such as ``my.setting``; those go through ``env``.

    Raises ValueError, naming the variable, where a name is empty or has ``=``, or either has a zero byte.
    """
    exports, others = [], []
    for name, value in environment.items():
        if not name or "=" in name or "\0" in name + value:
            raise ValueError(
                f"environment variable {name!r}: a name has no '=', and neither name nor value has a zero byte"
            )
        if _IDENTIFIER.fullmatch(name):
            exports.append(f"export {name}={shlex.quote(value)}\n")
        else:
            others.append(shlex.quote(f"{name}={value}"))
    if others:
        exports.append(f'set -- env {" ".join(others)} "$@"\n')
    return "".join(exports)

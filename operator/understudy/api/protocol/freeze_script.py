"""Pauses an application without ending its processes: a few lines of POSIX ``sh`` around the user's own command.

The agent may not signal processes of other containers, and does not need to: the script runs as the application's own user in
its own container, and stops and continues the processes. Agent and script communicate through the pod's shared emptyDir. A file
there means that the application must be held; a line through a FIFO only makes the script check for the file. So either of the
two can restart and find out the current state, and nothing polls.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from understudy.api import names

HELD_NAME = "cut-off"
"""File in the shared volume. It exists while the application must not run."""

Scope = Literal["all", "own"]
"""What is stopped. all: all processes that the container sees, since it sees no others. own: those in its control groups, where
it shares its process namespace with the rest of the pod."""

FENCE_SCRIPT = """\
understudy_held=$1/cut-off understudy_fence=$1/fence-$2 understudy_scope=$3
shift 3
[ -p "$understudy_fence" ] || exec "$@"
exec 3<>"$understudy_fence" 4<&0
trap 'exit 143' TERM INT
while [ -e "$understudy_held" ]; do read -r understudy_line <&3 || sleep 1; done
read -r understudy_main understudy_line </proc/self/stat
understudy_me=$understudy_main
understudy_groups() {
  understudy_found=
  while read -r understudy_line; do understudy_found="$understudy_found $understudy_line"; done 2>/dev/null <"$1"
}
understudy_groups /proc/self/cgroup
understudy_own=$understudy_found
understudy_signal() {
  if [ "$understudy_scope" = all ]; then kill "-$1" -1 2>/dev/null; return; fi
  for understudy_pass in 1 2; do
    for understudy_process in /proc/[0-9]*; do
      understudy_groups "$understudy_process/cgroup"
      [ "$understudy_found" = "$understudy_own" ] || continue
      case ${understudy_process#/proc/} in "$understudy_main" | "$understudy_me") continue ;; esac
      kill "-$1" "${understudy_process#/proc/}" 2>/dev/null
    done
  done
}
understudy_tell() {
  if [ -e "$understudy_held" ]; then understudy_signal KILL; else kill "-$1" "$understudy_application" 2>/dev/null; fi
}
if env --default-signal=INT,QUIT true 2>/dev/null; then set -- env --default-signal=INT,QUIT "$@"; fi
"$@" <&4 3<&- 4<&- &
understudy_application=$!
(
  read -r understudy_me understudy_line </proc/self/stat
  understudy_stopped=
  while :; do
    if [ -e "$understudy_held" ]; then
      understudy_signal STOP
      understudy_stopped=1
    elif [ "$understudy_stopped" ]; then
      understudy_signal CONT
      understudy_stopped=
    fi
    read -r understudy_line <&3 || sleep 1
  done
) 4<&- &
understudy_guard=$!
exec 3<&- 4<&-
for understudy_line in TERM INT QUIT HUP USR1 USR2; do
  trap "understudy_tell $understudy_line" "$understudy_line"
done
while :; do
  wait "$understudy_application"
  understudy_status=$?
  kill -0 "$understudy_application" 2>/dev/null || break
done
if [ "$understudy_status" -gt 128 ]; then
  wait "$understudy_application" 2>/dev/null
  understudy_again=$?
  [ "$understudy_again" = 127 ] || understudy_status=$understudy_again
fi
kill -KILL "$understudy_guard" 2>/dev/null
exit "$understudy_status"
"""
"""Arguments: directory, container, scope, the command. No ``$(`` and ``$$``: the kubelet expands those.

- The FIFO is made before any container starts (agent/prepare.py). Without it nobody could ask, and the script goes out of the way.
- A container that starts while it is held doesn't start its command before it is let go.
- The guard is begun after the command, and looks once before it reads: what was asked for in between isn't lost.
- ``kill -1`` leaves out the caller and the first process of the namespace, which are the guard and the script.
- Of the processes in control groups a second look finds those that were begun during the first.
- A signal that comes as the application ends may hide its exit code; it is asked for again.
- A shell without job control has background commands ignore INT and QUIT; ``env`` of GNU gives them back where it is there.
- Whoever ends a held application has given it up: it would wait for a continuation that never comes, so it is killed.
"""


def fence_name(container: str) -> str:
    """FIFO; a line through it makes the script look whether its application is held."""
    return f"fence-{container}"


def fenced_command(
    container: str,
    command: Sequence[str],
    args: Sequence[str],
    *,
    scope: Scope,
    directory: str = names.AGENT_DIR,
) -> list[str]:
    """Return the ``command`` (with no ``args``) that runs the given command in a way that lets the agent hold it.

    Raises ValueError if ``command`` is empty, because the image's entry point is unknown.
    """
    if not command:
        raise ValueError(f"container {container}: command is missing, and the image's entry point is unknown")
    return ["/bin/sh", "-c", FENCE_SCRIPT, "understudy-fence", directory, container, scope, *command, *args]

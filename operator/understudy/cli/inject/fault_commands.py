"""Shell programs that inject a fault from inside a container and end it by themselves.

They stop the processes of the container (its control group) except process 1, which the kernel protects from signals of its own
PID namespace. The program that undoes the fault runs in the container too, and does not depend on the caller.
"""

from __future__ import annotations

PERIOD = 0.1
"""Seconds of one cycle of stopping and continuing a slowed application."""

FREEZE_AND_SLOW = """\
cycles=$1 stopped=$2 running=$3 own=$(cat /proc/self/cgroup) found=
for entry in /proc/[0-9]*; do
  pid=${entry#/proc/}
  [ "$pid" = 1 ] || [ "$pid" = $$ ] || [ "$(cat "$entry/cgroup" 2>/dev/null)" != "$own" ] || found="$found $pid"
done
[ -n "$found" ] || {
  echo "it has only process 1, which cannot be stopped from inside; set shareProcessNamespace: true in its pod" >&2; exit 1
}
sleep "$running" || { echo "the sleep command of the image does not support fractions of seconds" >&2; exit 1; }
each() { for pid in $found; do kill "-$1" "$pid" || [ ! -e "/proc/$pid" ] || return 1; done; }
each STOP || { each CONT; echo "the user of the container is not allowed to stop its processes" >&2; exit 1; }
(
  trap "" HUP
  while :; do
    sleep "$stopped"; each CONT
    cycles=$((cycles - 1)); [ "$cycles" -gt 0 ] || break
    sleep "$running"; each STOP
  done
) </dev/null >/dev/null 2>&1 &
echo $! $found
"""
"""Stops and continues the processes in cycles; prints the id of the process that does it, and the stopped ids."""

UNDO = """\
kill "$1" 2>/dev/null; shift
for pid in "$@"; do kill -CONT "$pid" 2>/dev/null; done; :
"""
"""Ends the fault at once; its arguments are the output of the program above."""


def cycles(length: float, percent: int) -> tuple[int, float, float]:
    """Return the number of cycles, and the seconds for which the application is stopped and runs in each. 100 percent: one stop."""
    if percent >= 100:
        return 1, length, 0.0
    stopped = PERIOD * percent / 100
    return max(1, round(length / PERIOD)), stopped, PERIOD - stopped

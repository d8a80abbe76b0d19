"""Faults that can be made from within a container with nothing but a shell, and that end by themselves.

The processes are those of the container (its control group) but for number 1: the kernel shields that one from signals of its own
processes. What undoes a fault runs in the container too, so that it doesn't depend on whoever asked for it.
"""

from __future__ import annotations

PERIOD = 0.1
"""Seconds in which an application that is slowed down is stopped and let go on once."""

FREEZE_AND_SLOW = """\
cycles=$1 stopped=$2 running=$3 own=$(cat /proc/self/cgroup) found=
for entry in /proc/[0-9]*; do
  pid=${entry#/proc/}
  [ "$pid" = 1 ] || [ "$pid" = $$ ] || [ "$(cat "$entry/cgroup" 2>/dev/null)" != "$own" ] || found="$found $pid"
done
[ -n "$found" ] || {
  echo "it has no process but number 1, which can't be stopped from within; give its pod shareProcessNamespace: true" >&2; exit 1
}
sleep "$running" || { echo "the image's sleep knows no parts of seconds" >&2; exit 1; }
each() { for pid in $found; do kill "-$1" "$pid" || [ ! -e "/proc/$pid" ] || return 1; done; }
each STOP || { each CONT; echo "its processes can't be stopped by the user of the container" >&2; exit 1; }
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
"""Stops processes and lets them go on, so many times; says by which process, and whom."""

UNDO = """\
kill "$1" 2>/dev/null; shift
for pid in "$@"; do kill -CONT "$pid" 2>/dev/null; done; :
"""
"""Ends that at once, given what it said."""


def cycles(length: float, percent: int) -> tuple[int, float, float]:
    """How often an application is stopped, how long each time, and how long it then runs; in seconds. 100 percent: once, for all of it."""
    if percent >= 100:
        return 1, length, 0.0
    stopped = PERIOD * percent / 100
    return max(1, round(length / PERIOD)), stopped, PERIOD - stopped

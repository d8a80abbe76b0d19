"""``understudy blackbox NAME``: what a workload's monitor has recorded of its failures, and the recordings themselves."""

from __future__ import annotations

import argparse
import hashlib
import http.client
import os
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

from pydantic import ValidationError

from understudy.api import names
from understudy.api.kinds.recording_spec import Recording, Recordings
from understudy.api.output_formats import structured
from understudy.cli.common import option_rules, terminal
from understudy.cli.common.errors import CommandError
from understudy.cli.common.kubectl import Kubectl, add_options
from understudy.cli.common.text_tables import Cell, drawn
from understudy.cli.common.tree_text import plain
from understudy.cli.common.wording import age, clock, counted, wrapped
from understudy.cli.inspect.tree import asked, monitor_pod

DONE, NONE, CANT = 0, 1, 2
"""Exit statuses."""

LATEST = "latest"

_PATIENCE = 30.0  # seconds for a piece of a file to come
_PIECE = 1 << 16


def main(arguments: list[str]) -> int:
    """Run the command."""
    parser = _parser()
    given = parser.parse_args(arguments)
    fetches = given.fetch is not None
    option_rules.only(parser, given, fetches, "--to", "says where a recording is fetched into: give --fetch too")
    option_rules.only(
        parser, given, not fetches, "--output", "is for the list, not for --fetch, which --to tells where to"
    )
    try:
        kubectl = Kubectl(given)
        with kubectl.forwarded(monitor_pod(kubectl, given.name), names.RECORDINGS_PORT) as port:
            found = _listed(port)
            if given.fetch is None:
                return _show(found, given.output or "text")
            recording = _wanted(found, given.fetch)
            path = Path(given.to or f"{given.name}-{recording.number}.mcap")
            _fetch(port, recording, path)
    except CommandError as error:
        print(f"understudy blackbox: {error}", file=sys.stderr)
        return CANT
    except KeyboardInterrupt:
        return CANT
    print(f"{path}: {_what(recording)}")
    return DONE


def _listed(port: int) -> Recordings:
    try:
        return Recordings.model_validate(asked(port, "/", what="a black box"))
    except ValidationError as error:
        raise CommandError(
            f"the monitor answers otherwise than expected; is this command of its version? {error}"
        ) from error


def _show(found: Recordings, output: str) -> int:
    if output != "text":
        print(structured(found.to_wire(), output))
    else:
        for line in lines(
            found, time.time(), colours=terminal.colours(sys.stdout), columns=terminal.columns(sys.stdout)
        ):
            print(line)
    return DONE if found.recordings else NONE


def lines(found: Recordings, now: float, *, colours: bool, columns: int | None) -> Iterator[str]:
    """What there is, as people read it."""
    if found.recordings:
        head = [
            Cell(text)
            for text in ("NO", "ID", "FAILED", "AGO", "RESULT", "STRATEGY", "MESSAGES", "SIZE", "WHAT FAILED")
        ]
        yield from drawn(
            [head, *([Cell(text) for text in _row(one, now)] for one in found.recordings)], colours=colours
        )
    elif found.on:
        yield "Nothing has failed since the recordings lie where they do."
    if not found.on:
        yield from wrapped(
            "Nothing is recorded: spec.blackBox of the workload's FailurePolicy isn't given (docs/blackbox.md).",
            columns,
            indent=0,
        )
    for text in _left_out(found.left_out):
        yield from wrapped(f"Not recorded: {text}.", columns, indent=0)


def _row(one: Recording, now: float) -> tuple[str, ...]:
    told = (str(one.number), one.id, clock(one.failed), age(one.failed, now), one.result, one.strategy or "none")
    return (*told, str(one.messages), _size(one.size), one.reason)


def _left_out(topics: Mapping[str, str]) -> Iterator[str]:
    return (f"{topic} ({why}; blackBox.memory bounds it)" for topic, why in topics.items())


def _size(size: int) -> str:
    """Bytes, in the unit in which they are a number of up to three digits."""
    amount = float(size)
    for unit in ("B", "kB", "MB"):
        if amount < 999.5:
            return f"{amount:.3g} {unit}"
        amount /= 1000
    return f"{amount:.3g} GB"


def _what(one: Recording) -> str:
    left_out = f"; without {', '.join(plain(topic) for topic in one.left_out)}" if one.left_out else ""
    return f"{counted(one.messages, 'message')} around failure {one.number} ({plain(one.reason)}), {_size(one.size)}{left_out}"


def _wanted(found: Recordings, wanted: str) -> Recording:
    """The recording that is meant: by its number, or its id or the beginning of it. Raises CommandError."""
    if not found.recordings:
        raise CommandError(f"there is no recording of {found.workload}")
    if wanted == LATEST:
        return found.recordings[0]
    # An id may begin with any digit.
    for one in found.recordings:
        if str(one.number) == wanted:
            return one
    begun = [one for one in found.recordings if one.id.startswith(wanted)]
    if len(begun) == 1:
        return begun[0]
    there = ", ".join(f"{one.id} (failure {one.number})" for one in begun or found.recordings)
    if begun:
        raise CommandError(f"several recordings of {found.workload} begin with {wanted}: {there}")
    raise CommandError(f"there is no recording {wanted} of {found.workload}, but {there}")


def _fetch(port: int, recording: Recording, path: Path) -> None:
    """Have a recording in a file, whole or not at all. Raises CommandError."""
    fresh = path.with_name(f"{path.name}.part")
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=_PATIENCE)
    checksum = hashlib.sha256()
    try:
        connection.request("GET", f"/{recording.id}.mcap")
        answer = connection.getresponse()
        if answer.status != 200:
            raise CommandError(f"recording {recording.id} is gone: a newer one has taken its place")
        with fresh.open("wb") as file:
            while piece := answer.read(_PIECE):
                checksum.update(piece)
                file.write(piece)
        if checksum.hexdigest() != recording.sha256:
            raise CommandError(
                f"recording {recording.id} is damaged, on the monitor's disk or on its way: its checksum is another"
            )
        os.replace(fresh, path)
    except http.client.HTTPException as error:
        raise CommandError(f"recording {recording.id} didn't come whole: {error!r}") from error
    except OSError as error:
        raise CommandError(f"recording {recording.id} can't be fetched into {path}: {error}") from error
    finally:
        connection.close()
        fresh.unlink(missing_ok=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy blackbox",
        # By itself it would say the options first, and a name after --fetch is taken for an id.
        usage="%(prog)s NAME [options]",
        description="Lists what the monitor of a RobotWorkload has recorded around its failures, or fetches a recording: an MCAP file as "
        "rosbag2 writes them. The policy asks for it (spec.blackBox). Needs kubectl and the right to forward ports to pods.",
        epilog="Exit status: 0 where there are recordings, or it is fetched, 1 where there are none, 2 where it can't be told or fetched.",
    )
    parser.add_argument("name", metavar="NAME", help="the RobotWorkload")
    parser.add_argument(
        "--fetch",
        metavar="ID",
        nargs="?",
        const=LATEST,
        help=f"fetch a recording, by the number of the failure, its id or the beginning of it, or {LATEST} (which is meant where "
        "nothing is said)",
    )
    parser.add_argument("--to", metavar="FILE", help="the file that it is fetched into (NAME-NUMBER.mcap)")
    parser.add_argument("-o", "--output", choices=["text", "json", "yaml"], help="the list as text, or as JSON or YAML")
    add_options(parser)
    return parser

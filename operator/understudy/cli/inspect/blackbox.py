"""``understudy blackbox NAME``: lists and fetches what a workload's monitor recorded around its failures."""

from __future__ import annotations

import argparse
import hashlib
import http.client
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

from pydantic import ValidationError

from understudy.api import names
from understudy.api.kinds.recording_spec import Recording, Recordings
from understudy.api.output_formats import structured
from understudy.api.plain_text import plain
from understudy.cli.common import option_rules
from understudy.cli.common.cluster_access.kubectl import Kubectl, add_options, add_robot
from understudy.cli.common.errors import ERROR, CommandError, reports_errors
from understudy.cli.common.text import terminal
from understudy.cli.common.text.text_tables import format_texts
from understudy.cli.common.text.wording import age, clock, counted, wrapped
from understudy.cli.inspect.tree import fetch_json, monitor_pod
from understudy.process.file_replacement import replaced_file

SUCCESS, NONE = 0, 1
"""Exit statuses besides ERROR."""

LATEST = "latest"

_PATIENCE = 30.0  # seconds until the next piece of a file
_PIECE = 1 << 16


@reports_errors("blackbox")
def main(arguments: list[str]) -> int:
    """Run the command."""
    parser = _parser()
    options = parser.parse_args(arguments)
    fetches = options.fetch is not None
    option_rules.reject_unless(parser, options, fetches, "--to", "names the file for --fetch, which is not given")
    option_rules.reject_unless(
        parser, options, not fetches, "--output", "applies to the list, not to --fetch; --to names the file for --fetch"
    )
    try:
        kubectl = Kubectl(options)
        with kubectl.forwarded(monitor_pod(kubectl, options.name), names.RECORDINGS_PORT) as port:
            found = _listed(port)
            if options.fetch is None:
                return _show(found, options.output or "text")
            recording = _wanted(found, options.fetch)
            path = Path(options.to or f"{options.name}-{recording.number}.mcap")
            _fetch(port, recording, path)
    except KeyboardInterrupt:
        return ERROR
    print(f"{path}: {_what(recording)}")
    return SUCCESS


def _listed(port: int) -> Recordings:
    try:
        return Recordings.model_validate(fetch_json(port, "/", what="a black box"))
    except ValidationError as error:
        raise CommandError(
            f"the monitor's answer is not understood; does this command have the same version? {error}"
        ) from error


def _show(found: Recordings, output: str) -> int:
    if output != "text":
        print(structured(found.to_wire(), output))
    else:
        print("\n".join(lines(found, time.time(), columns=terminal.columns(sys.stdout))))
    return SUCCESS if found.recordings else NONE


def lines(found: Recordings, now: float, *, columns: int | None) -> Iterator[str]:
    """Format the list of recordings."""
    if found.recordings:
        head = ("NO", "ID", "FAILED", "AGO", "RESULT", "STRATEGY", "MESSAGES", "SIZE", "REASON")
        yield from format_texts([head, *(_row(one, now) for one in found.recordings)])
    elif found.on:
        yield "No failure has been recorded yet."
    if not found.on:
        yield from wrapped(
            "Recording is off: set spec.blackBox in the workload's FailurePolicy (docs/blackbox.md).",
            columns,
            indent=0,
        )
    for text in _left_out(found.left_out):
        yield from wrapped(f"Not recorded: {text}.", columns, indent=0)


def _row(one: Recording, now: float) -> tuple[str, ...]:
    cells = (str(one.number), one.id, clock(one.failed), age(one.failed, now), one.result, one.strategy or "none")
    return (*cells, str(one.messages), _size(one.size), one.reason)


def _left_out(topics: Mapping[str, str]) -> Iterator[str]:
    return (f"{topic} ({why}; blackBox.memory bounds it)" for topic, why in topics.items())


def _size(size: int) -> str:
    """Format a size in bytes with the unit in which it has up to three digits."""
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
    """Return the recording with a number, or an id or the beginning of one. Raises CommandError."""
    if not found.recordings:
        raise CommandError(f"there is no recording of {found.workload}")
    if wanted == LATEST:
        return found.recordings[0]
    # Numbers first, because an id may begin with any digit.
    for one in found.recordings:
        if str(one.number) == wanted:
            return one
    matches = [one for one in found.recordings if one.id.startswith(wanted)]
    if len(matches) == 1:
        return matches[0]
    there = ", ".join(f"{one.id} (failure {one.number})" for one in matches or found.recordings)
    if matches:
        raise CommandError(f"{wanted} matches several recordings of {found.workload}: {there}")
    raise CommandError(f"there is no recording {wanted} of {found.workload}; available: {there}")


def _fetch(port: int, recording: Recording, path: Path) -> None:
    """Download a recording to a file, completely or not at all. Raises CommandError."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=_PATIENCE)
    checksum = hashlib.sha256()
    try:
        connection.request("GET", f"/{recording.id}.mcap")
        answer = connection.getresponse()
        if answer.status != 200:
            raise CommandError(f"recording {recording.id} is gone: it was replaced by a newer one")
        with replaced_file(path) as file:
            while piece := answer.read(_PIECE):
                checksum.update(piece)
                file.write(piece)
            if checksum.hexdigest() != recording.sha256:
                raise CommandError(
                    f"recording {recording.id} is damaged, on the monitor's disk or in transit: its checksum does not match"
                )
    except http.client.HTTPException as error:
        raise CommandError(f"recording {recording.id} was not received completely: {error!r}") from error
    except OSError as error:
        raise CommandError(f"recording {recording.id} cannot be written to {path}: {error}") from error
    finally:
        connection.close()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy blackbox",
        # argparse would put the options first, and a name after --fetch would be parsed as an id.
        usage="%(prog)s NAME [options]",
        description="Lists the recordings that the monitor of a RobotWorkload made of failures, or fetches one as "
        "an MCAP file that rosbag2 can read. The policy turns recording on (spec.blackBox). The command needs "
        "kubectl and the permission to forward ports to pods.",
        epilog="Exit status: 0 if there are recordings, or the recording was fetched, 1 if there are none, 2 on an error.",
    )
    option_rules.add_examples(
        parser, "understudy blackbox robot-1 -n fleet", "understudy blackbox robot-1 --fetch latest --to failure.mcap"
    )
    add_robot(parser)
    parser.add_argument(
        "--fetch",
        metavar="ID",
        nargs="?",
        const=LATEST,
        help=f"fetch a recording. ID is the number of the failure, its id, a prefix of its id, or {LATEST}, which is also the "
        "default for --fetch without ID",
    )
    parser.add_argument("--to", metavar="FILE", help="the file for the recording (default: NAME-NUMBER.mcap)")
    parser.add_argument(
        "-o", "--output", choices=["text", "json", "yaml"], help="format of the list: text, JSON or YAML"
    )
    add_options(parser)
    return parser

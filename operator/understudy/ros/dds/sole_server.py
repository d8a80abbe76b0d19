"""Runs a discovery server for as long as the workload's Service leads to it, and ends it when the Service leads to another one.

    python -m understudy.ros.dds.sole_server ADDRESS PORT BESIDE COMMAND [ARGUMENT...]

All discovery servers of a workload have one GUID, since a participant knows no other. Two that run beside each other, such as one on a
node that counts as lost and its successor, answer the same participants, which then discover only some of each other. Neither
Kubernetes nor the operator can end a server on a node that they cannot reach. So each server asks ADDRESS, that of the Service, every
second who answers there: the answer is a token that each process draws for itself.

A server is killed (SIGKILL), so that it sends nothing more. One that ends by itself tells each participant that it is gone, and often a
millisecond later once more, from its history. A participant forgets the server at the first message, and takes the second one for the
beginning of the next server. Then it ignores the next server, which counts its heartbeats and samples from 1, until these numbers exceed
those of the server that ended. That can take minutes and outlast several servers: a participant notices only the end of a server
that it has accepted. Without such a message, participants notice the end 2 s after they last heard the server, and the next one waits
for that.

Two servers may still run beside each other for some seconds, for example when a node returns. A participant that heard both mixes up
their numbers in the same way. So a server that ends for another one, or that is ended, reports to it that they ran beside each other.
The other one is killed too and starts again, which resets the participants.

A server that receives no answer goes on: the network may be down, or may not lead a pod back to itself. A server on a node that was cut
off asks only itself, until its node knows again where the Service leads. That may be seconds after its packets reach the participants
again. So its successor looks for it at its own address, to end it with the first packet that gets through.

ADDRESS and PORT (UDP) are those at which servers ask and answer. BESIDE is a file with the annotation understudy.dev/beside of this pod,
which names a predecessor (UID/ADDRESS); it may be missing. COMMAND is the server, which starts once no other process has answered for a
while.
"""

from __future__ import annotations

import contextlib
import hashlib
import secrets
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

PERIOD = 1.0
"""Seconds between two questions."""

ANSWER_WITHIN = 0.5
"""Seconds that an answer may take. A later one counts as none."""

QUIET = 3.0
"""Seconds without an answer of another process after which a server starts. The participants have noticed by then that the former
one is gone, and introduce themselves to this one (docker/understudy-discovery-server)."""

REPLACED_AFTER = 2
"""Answers of another process in a row after which a server ends. The other one answers from its start, so that this server ends before
the other one begins."""

LAST_WORDS = 1.0
"""Maximum seconds in which a server that is ended looks for another one to which the Service leads."""

SUCCEEDS_EVERY = 0.1
"""Seconds between two packets to a predecessor that may live on. Its server announces itself twice a second."""

PAUSE = 0.001
"""Seconds between two packets from others. A flood of them so takes little processor time from the processes beside this one. The
queue of the kernel holds some hundred packets, so that a question is answered in time."""

TOKEN = 16
"""Bytes of a token, of the nonce that belongs to a question, and of what names the Service in a packet to another server."""

RAN_BESIDE = b"beside"
"""The end of a packet that reports that the sender's server and the receiver's ran beside each other."""

Answer = Literal["self", "another", "nobody"]


class _Ended(Exception):
    """A signal ends this process."""


class SoleServer:
    """One server, and the questions to the Service."""

    def __init__(self, address: str, port: int, beside: Path, command: Sequence[str]) -> None:
        self._at, self._beside, self._command = (address, port), beside, command
        self._service = hashlib.sha256(address.encode()).digest()[:TOKEN]
        """What names the Service: the address of a pod that is gone may be that of another workload's server now."""
        self._successor: str | None = None
        """The address from which another server has reported to be the successor of this one."""
        self._is_mixed_up = False
        """Whether another server has reported that it ran beside this one."""
        self._family = socket.AF_INET6 if ":" in address else socket.AF_INET
        self._token = secrets.token_bytes(TOKEN)
        self._server: subprocess.Popen[bytes] | None = None
        self._is_successor = False
        """Whether this server runs, or starts again, in the place of its predecessor."""
        self._answering = socket.socket(self._family, socket.SOCK_DGRAM)
        self._answering.bind(("", port))
        self._has_ended = False
        """Whether a signal has ended the server. Questions are not answered any more."""

    def run(self) -> int:
        """Run until the command ends by itself, or a signal ends this process. Returns the exit status."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._end)
        others, quiet_since = 0, time.monotonic()
        try:
            while True:
                asked = time.monotonic()
                if self._successor is not None:
                    others = REPLACED_AFTER if self._ask(self._successor) == "another" else others
                    self._successor = None
                else:
                    answer = self._ask(self._at[0])
                    others = others + 1 if answer == "another" else 0 if answer == "self" else others
                is_mixed_up, self._is_mixed_up = self._is_mixed_up, False
                if self._server is None:
                    if others or is_mixed_up:
                        self._is_successor = self._is_successor and not others
                        others, quiet_since = 0, asked
                    elif asked - quiet_since >= QUIET:
                        self._server, self._is_successor = subprocess.Popen(self._command), True
                elif (status := self._server.poll()) is not None:
                    return status
                elif others >= REPLACED_AFTER or is_mixed_up:
                    self._is_successor = others < REPLACED_AFTER
                    if self._is_successor:
                        print("another discovery server ran beside this one: this one starts again", flush=True)
                    else:
                        print("another discovery server is in this one's place: this one ends", flush=True)
                    self._stop()
                    others, quiet_since = 0, time.monotonic()
                self._serve(asked + PERIOD, asked + SUCCEEDS_EVERY)
        except _Ended:
            if self._server is not None:
                self._stop()
                self._report_end()
            return 0
        finally:
            self._stop()
            self._answering.close()

    def _end(self, *_: object) -> None:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_IGN)
        raise _Ended  # a wait for packets would go on

    def _stop(self) -> None:
        if self._server is not None:
            self._server.kill()
            self._server.wait()
        self._server = None

    def _report_end(self) -> None:
        """Report to the server to which the Service leads, if any, that another one ran until now."""
        self._has_ended = True
        end = time.monotonic() + LAST_WORDS
        while (asked := time.monotonic()) < end:
            if self._ask(self._successor or self._at[0]) == "another":
                return
            time.sleep(max(0.0, asked + SUCCEEDS_EVERY - time.monotonic()))

    def _ask(self, address: str) -> Answer:
        """Ask from a port of its own, so that the answer comes from where the Service leads now.

        Reports to another server that this one runs, or ran until a signal ended it.
        """
        nonce = secrets.token_bytes(TOKEN)
        with socket.socket(self._family, socket.SOCK_DGRAM) as asking, contextlib.suppress(OSError):
            asking.sendto(nonce, (address, self._at[1]))
            end = time.monotonic() + ANSWER_WITHIN
            while (left := end - time.monotonic()) > 0:
                if asking in self._wait(left, asking):
                    answer = asking.recv(2 * TOKEN + 1)
                    if answer[:TOKEN] == nonce and len(answer) == 2 * TOKEN:
                        if answer[TOKEN:] == self._token:
                            return "self"
                        if self._has_ended or self._server is not None:
                            asking.sendto(self._service + RAN_BESIDE, (address, self._at[1]))
                        return "another"
        return "nobody"

    def _serve(self, end: float, least: float) -> None:
        """Answer, and look for the predecessor, until a time by the monotonic clock; from ``least`` on only until a successor reports."""
        due = 0.0
        while (now := time.monotonic()) < end and not (self._successor is not None and now >= least):
            if now >= due:
                self._succeed()
                due = now + SUCCEEDS_EVERY
            self._wait(min(due, end) - now)

    def _succeed(self) -> None:
        """Report to the predecessor that this server is in its place."""
        if not self._is_successor:
            return
        with contextlib.suppress(OSError):  # there is no such file, or no way to its address
            predecessor = self._beside.read_text().strip().partition("/")[2]
            if predecessor:
                self._answering.sendto(self._service + self._token, (predecessor, self._at[1]))

    def _wait(self, seconds: float, *also: socket.socket) -> list[socket.socket]:
        """Wait for a packet for at most a number of seconds, and answer a question. Returns the sockets that have one."""
        readable, _, _ = select.select([self._answering, *also], [], [], seconds)
        if self._answering in readable:
            with contextlib.suppress(OSError):
                packet, sender = self._answering.recvfrom(2 * TOKEN + 1)
                if len(packet) == TOKEN and not self._has_ended:
                    self._answering.sendto(packet + self._token, sender)
                elif len(packet) == 2 * TOKEN and packet[:TOKEN] == self._service:
                    self._successor = sender[0]
                elif packet == self._service + RAN_BESIDE:
                    self._is_mixed_up = True
            time.sleep(PAUSE)
        return readable


if __name__ == "__main__":
    sys.exit(SoleServer(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]), sys.argv[4:]).run())

"""Runs inside a pod of the policy tests: answers on its ports, and sends to others on command.

Started with `kubectl exec -i POD -- python3 -c SOURCE PORT...`; requests and answers are one JSON object per line, so it needs nothing
from the network it tests. Standard library only. ADDRESS in its environment is the one that it answers at, if its host has several.
"""

import contextlib
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

PATIENCE = 0.45
TRIES = 3
ADDRESS = os.environ.get("ADDRESS", "")

_print = threading.Lock()
_state = threading.Lock()
_arrivals: list[list[Any]] = []
_flows: dict[str, tuple[socket.socket, bool]] = {}
_streams: dict[str, tuple[threading.Event, threading.Thread]] = {}


def answer_udp(port: int) -> None:
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listener.bind((ADDRESS, port))
    while True:
        data, sender = listener.recvfrom(2048)
        if data.startswith(b"stream "):
            name, number, sent = data.decode().split()[1:]
            with _state:
                _arrivals.append([name, int(number), int(sent), time.time_ns()])
        else:
            listener.sendto(data, sender)


def answer_tcp(port: int) -> None:
    listener = socket.create_server((ADDRESS, port), backlog=64)
    while True:
        connection, _ = listener.accept()
        threading.Thread(target=echo, args=(connection,), daemon=True).start()


def echo(connection: socket.socket) -> None:
    with connection:
        try:
            while data := connection.recv(2048):
                connection.sendall(data)
        except OSError:
            return


def connect(protocol: str, address: str, port: int) -> socket.socket:
    if protocol == "tcp":
        return socket.create_connection((address, port), timeout=PATIENCE)
    talker = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    talker.connect((address, port))
    return talker


def say(talker: socket.socket, stream: bool) -> bool:
    """Whether a message comes back."""
    token = f"{time.time_ns():x}".encode()
    seen = b""
    for attempt in range(TRIES):
        try:
            if attempt == 0 or not stream:
                talker.send(token)
            end = time.monotonic() + PATIENCE / TRIES
            while (left := end - time.monotonic()) > 0:
                talker.settimeout(left)
                seen += talker.recv(2048)
                if token in seen:
                    return True
        except OSError:  # a timeout, or a refusal that came back
            continue
    return False


def probe(protocol: str, address: str, port: int) -> bool:
    try:
        with connect(protocol, address, port) as talker:
            return say(talker, protocol == "tcp")
    except OSError:
        return False


def open_flow(flow: str, protocol: str, address: str, port: int) -> bool:
    _flows[flow] = (connect(protocol, address, port), protocol == "tcp")
    return say(*_flows[flow])


def say_again(flow: str) -> bool:
    return say(*_flows[flow])


def stream(name: str, address: str, port: int, every: float) -> bool:
    """Sends numbered messages, each with the wall clock in nanoseconds, until it is asked to stop."""
    talker = connect("udp", address, port)
    stop = threading.Event()

    def run() -> None:
        number = 0
        while not stop.wait(every):
            with contextlib.suppress(OSError):
                talker.send(f"stream {name} {number} {time.time_ns()}".encode())
            number += 1

    thread = threading.Thread(target=run, daemon=True)
    _streams[name] = (stop, thread)
    thread.start()
    return True


def stop(name: str) -> bool:
    event, thread = _streams.pop(name)
    event.set()
    thread.join()
    return True


def arrivals() -> list[list[Any]]:
    with _state:
        taken = list(_arrivals)
        _arrivals.clear()
    return taken


COMMANDS: dict[str, Callable[..., Any]] = {
    "probe": probe,
    "open": open_flow,
    "say": say_again,
    "stream": stream,
    "stop": stop,
    "arrivals": arrivals,
}


def work(number: int, command: str, arguments: dict[str, Any]) -> None:
    try:
        answer = {"id": number, "result": COMMANDS[command](**arguments)}
    except Exception as error:
        answer = {"id": number, "error": f"{type(error).__name__}: {error}"}
    with _print:
        print(json.dumps(answer), flush=True)


def main(ports: list[int]) -> None:
    for port in ports:
        threading.Thread(target=answer_udp, args=(port,), daemon=True).start()
        threading.Thread(target=answer_tcp, args=(port,), daemon=True).start()
    time.sleep(0.2)
    print(json.dumps({"id": 0, "result": "ready"}), flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        threading.Thread(target=work, args=(request["id"], request["do"], request.get("with", {})), daemon=True).start()


if __name__ == "__main__":
    main([int(port) for port in sys.argv[1:]])

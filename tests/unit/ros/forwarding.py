"""A process that forwards outputs (JSON): the name of an instance on each line of its input is whom it forwards from then on.

Writes, for each line, how many commands it has forwarded so far, once the instance is known from discovery.
"""

from __future__ import annotations

import asyncio
import os
import sys

from pydantic import TypeAdapter

from understudy.api.kinds.robot_workload import Output


async def main(text: str) -> None:
    from understudy.ros.actions.forwarded_outputs import routes
    from understudy.ros.rmw import MIDDLEWARE
    from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
    from understudy.ros.runtime.graph_node import Graph

    graph, wakeups = Graph("mux"), ArrivalWakeups()
    ways = routes(TypeAdapter(list[Output]).validate_json(text), graph, wakeups)
    instances: dict[bytes, str] = {}
    forwarded, source = 0, ""

    def forwards(writer: bytes) -> bool | None:
        if writer not in instances:
            return None
        return bool(source) and instances[writer] == source

    def drain() -> None:
        nonlocal forwarded
        wakeups.clear()
        forwarded += sum(way.drain(forwards) for way in ways)

    async def follow() -> None:
        while True:
            for way in ways:
                way.follow(list(instances))
            unknown = [end.gid for way in ways for end in way.writers() if end.gid not in instances]
            if unknown:
                instances.update(await MIDDLEWARE.instances_of_writers(unknown, "127.0.0.1", os.environ, within=1.0))
                drain()
            await asyncio.sleep(0.1)

    loop = asyncio.get_running_loop()
    loop.add_reader(wakeups.descriptor, drain)
    following = loop.create_task(follow())
    lines = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    print("ready", flush=True)
    while wanted := (await lines.readline()).decode():
        while wanted.strip() and wanted.strip() not in instances.values():
            await asyncio.sleep(0.1)
        drain()
        if source != wanted.strip():
            for way in ways:
                way.forget()
        source = wanted.strip()
        print(forwarded, flush=True)
    following.cancel()


asyncio.run(main(sys.argv[1]))

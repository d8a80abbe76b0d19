"""A process that forwards a topic: the name of an instance on each line of its input is whom it forwards from then on.

Writes, for each line, how many samples it has forwarded so far, once the instance is known from discovery.
"""

from __future__ import annotations

import asyncio
import os
import sys


async def main(topic: str, type_name: str) -> None:
    from understudy.ros.actions.forwarded_topic import ForwardedTopic
    from understudy.ros.rmw import MIDDLEWARE
    from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
    from understudy.ros.runtime.graph_node import Graph
    from understudy.ros.runtime.sample_taking import Sample, SampleTaker

    graph, wakeups = Graph("mux"), ArrivalWakeups()
    route = ForwardedTopic(graph, topic, type_name, SampleTaker(), wakeups)
    instances: dict[bytes, str] = {}
    forwarded, source = 0, ""

    def forwards(sample: Sample) -> bool:
        return bool(source) and instances.get(sample.gid) == source

    def drain() -> None:
        nonlocal forwarded
        wakeups.clear()
        forwarded += route.drain(forwards)

    loop = asyncio.get_running_loop()
    loop.add_reader(wakeups.descriptor, drain)
    lines = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    print("ready", flush=True)
    while wanted := (await lines.readline()).decode():
        while wanted.strip() and wanted.strip() not in instances.values():
            unknown = [end.gid for end in graph.publishers(topic) if end.gid not in instances]
            instances |= await MIDDLEWARE.instances_of_writers(unknown, "127.0.0.1", os.environ, within=1.0)
        drain()
        source = wanted.strip()
        print(forwarded, flush=True)


asyncio.run(main(*sys.argv[1:]))

"""Robots that all want a pod of the same pool at the same moment; part of the tests of contention, and a process of its own.

    python -m tests.cluster.contending KUBECONFIG NAMESPACE POOL WHO ROBOT...

Says ``ready`` when all have read the objects, waits for a line, has them contend, and prints the results as JSON. WHO is
in their claims, since a robot may have several that act for it, as two monitors of one workload would.
"""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack
from dataclasses import asdict, dataclass, field

from tests.support import gates
from understudy.api import names
from understudy.kube import claims
from understudy.kube.client import NETWORK_POLICIES, PODS, WORKLOADS, Access, ApiError, Client, Object
from understudy.kube.gates.base import GateRecord
from understudy.kube.kubeconfig import load_access


@dataclass
class Outcome:
    """The result of one contender."""

    robot: str
    claim: str
    pod: str = ""
    """The UID of the pod that it won; empty where others were first everywhere."""
    lost: list[str] = field(default_factory=list)
    """UIDs of the pods that it lost."""
    opened: bool = False
    """Whether it won its robot's gate too."""


class Contender:
    """Acts for a robot, with a client of its own."""

    def __init__(self, client: Client, namespace: str, robot: str) -> None:
        self._client, self._namespace, self._robot = client, namespace, robot
        self._uid = ""
        self._gate: GateRecord | None = None
        self._free: list[Object] = []

    async def read(self, pool: str) -> None:
        """Read what there is; all that follows goes by it, however old it has become."""
        client, namespace = self._client, self._namespace
        self._uid = (await client.get(WORKLOADS, namespace, self._robot))["metadata"]["uid"]
        self._gate = GateRecord.of(await client.get(NETWORK_POLICIES, namespace, names.gate(self._robot)))
        found = await client.list(PODS, namespace, labels=f"{names.POOL}={pool},{names.CLAIMED_BY}=")
        self._free = sorted(found["items"], key=lambda pod: str(pod["metadata"]["name"]))

    async def contend(self, who: str) -> Outcome:
        """Claim the first pod that nobody else has claimed, and open the gate for it."""
        outcome = Outcome(self._robot, f"{self._uid}/{who}")
        for pod in self._free:
            try:
                won = await claims.claim(
                    self._client, pod, workload=self._robot, workload_uid=self._uid, claim=outcome.claim
                )
            except ApiError as error:
                if not error.conflict:
                    raise
                outcome.lost.append(pod["metadata"]["uid"])
                continue
            outcome.pod = won["metadata"]["uid"]
            outcome.opened = await self._open(won)
            break
        return outcome

    async def _open(self, pod: Object) -> bool:
        assert self._gate is not None, "it has read first"
        name, uid = pod["metadata"]["name"], pod["metadata"]["uid"]
        try:
            await gates.commit(
                self._client, self._namespace, self._robot, over=self._gate, active=name, active_uid=uid, recovery=""
            )
        except ApiError as error:
            if not error.conflict:
                raise
            return False
        return True


async def contend(
    access: Access, namespace: str, pool: str, who: str, robots: Sequence[str], begin: Callable[[], object]
) -> list[Outcome]:
    """Have all robots contend at once, when ``begin`` has returned; it is called in a thread when all have read."""
    async with AsyncExitStack() as stack:
        clients = [await stack.enter_async_context(Client(access)) for _ in robots]
        contenders = [Contender(client, namespace, robot) for client, robot in zip(clients, robots, strict=True)]
        await asyncio.gather(*(one.read(pool) for one in contenders))
        await asyncio.to_thread(begin)
        return await asyncio.gather(*(one.contend(who) for one in contenders))


def _begin() -> None:
    print("ready", flush=True)
    sys.stdin.readline()


def main(kubeconfig: str, namespace: str, pool: str, who: str, *robots: str) -> None:
    """Contend, and print the result."""
    outcomes = asyncio.run(contend(load_access(kubeconfig), namespace, pool, who, robots, _begin))
    print(json.dumps([asdict(outcome) for outcome in outcomes]))


if __name__ == "__main__":
    main(*sys.argv[1:])

"""What must hold after every write and whenever what reaches a robot changes, and what must be so once all is calm."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

from tests.unit.interleavings import gates
from tests.unit.interleavings.apiserver import ApiServer
from tests.unit.interleavings.commands import Commands
from tests.unit.interleavings.drivers import Drivers
from tests.unit.interleavings.kept_states import KeptStates
from tests.unit.interleavings.pods import Running
from tests.unit.interleavings.robots import Robots
from tests.unit.interleavings.senses import GAP
from tests.unit.interleavings.undriven import Undriven
from understudy.api import names
from understudy.api.kinds.robot_workload import RobotWorkloadStatus
from understudy.controller.observed import kube_objects, leaving_nodes
from understudy.controller.pods import pool_size
from understudy.failover import progress as recoveries
from understudy.failover.progress import Committed
from understudy.kube import claims
from understudy.kube.apply import controller_of
from understudy.kube.client import Object
from understudy.kube.gates.base import GateRecord

KNOWN = 70.0
"""Seconds within which an operator knows of a pool's new size, or of a pod that has gone: two of its lists, and their longest waits."""


FOLLOWS = 0.05
"""Seconds within which the network has followed a change of labels."""

STALE = 3.0
"""Seconds for which an instance has been healthy again before it must not be fenced for a failure before that."""


class Invariants:
    """Checks all invariants and reports violations."""

    most_through = 1
    """Instances that a gate may let through at once."""

    def __init__(
        self, server: ApiServer, robots: Robots, *, broken: Callable[[str], None], leads: Callable[[str], bool]
    ) -> None:
        """``leads`` tells whether the operator of a name does."""
        self._server, self._robots, self._broken, self._leads = server, robots, broken, leads
        self._stragglers: set[str] = set()
        """Pods that an operator had asked for and that came when it led no longer: nobody could count with them."""
        self._sizes: dict[str, list[tuple[float, int]]] = {}
        """By pool, since when it was to have how many pods."""
        self._emptied: dict[str, float] = {}
        """By node, until when an operator may take it for one that is to be emptied."""
        self._gone: list[tuple[float, Object]] = []
        """When pods of the workloads' own controllers have gone: an operator may still see them."""
        self._deleted_templates: dict[tuple[str, str], str | None] = {}
        """By namespace and name, the last template of each ReplicaSet that was deleted, as its hash."""
        self.failed: dict[str, float] = {}
        """Pods that failed for good while they were in control, and when."""
        self._tampered: dict[str, dict[str, str]] = {}
        """By UID, the labels of pods of which somebody has edited some, until they have been restored."""
        self._restored_at: dict[str, float] = {}
        """By UID, when that was: the network needs a moment to follow."""
        self.fenced: set[str] = set()
        """Robots whose gate a user has closed: it stays closed until the user resumes the workload."""
        self.commits = self.claims = self.creations = 0
        self.commands = Commands(lambda: robots.now, broken)
        self.drivers = Drivers(
            lambda: robots.now, broken, self._heard, lambda found: not robots.nodes.is_forgotten(found.node)
        )
        self.kept_states = KeptStates(lambda text: None if robots.clocks_differ else broken(text))
        self.undriven = Undriven(lambda: robots.now, broken)
        for workload, gate in gates.everyone(server):
            self.commands.see(workload, GateRecord.of(gate))

    # -- at every write ---------------------------------------------------------------------------------------------

    def see(self, plural: str, old: Object | None, new: Object | None, by: str) -> None:
        """A write was made."""
        if plural == "replicasets" and old is not None and new is None:
            metadata = old["metadata"]
            self._deleted_templates[metadata["namespace"], metadata["name"]] = _template(old)
        if plural == "pods":
            self._restored(new)
            if by != "somebody":
                self._owners(old, new)
            if old is None and new is not None and by.startswith("operator"):
                self._created(new, by)
            if old is not None and _labels(old).get(names.SOURCE) == "workload" and _deleted(old, new):
                self._gone.append((self._robots.now, old))
            if by.startswith("monitor") and old is not None and _deleted(old, new):
                self._ended_by_monitor(old, by)
            if by.startswith("operator") and old is not None and _claimed(old) and _deleted(old, new):
                self._broken(f"{by} deleted {_name(old)}, which is claimed")
        elif plural == "robotworkloads" and new is not None and not self._robots.clocks_differ:
            for recovery in (new.get("status") or {}).get("recoveries") or []:
                self.drivers.recorded(_name(new), recovery, by)
        elif plural == "fallbackpools" and new is not None and old is not None:
            sizes = self._sizes.setdefault(_name(new), [(self._robots.now, _size(old))])
            sizes += [(self._robots.now, _size(old)), (self._robots.now, _size(new))]
        elif plural == "nodes" and new is not None:
            self._emptied[_name(new)] = math.inf if leaving_nodes.is_cordoned(new) else self._robots.now + KNOWN
        elif new is not None and gates.is_gate(plural, new):
            self._gate(old, new)

    def tampered(self, pod: Object) -> None:
        """Somebody edits labels of a pod."""
        wanted = {
            key: value for key, value in _labels(pod).items() if key in (names.WORKLOAD, names.CLAIMED_BY, names.POOL)
        }
        self._tampered.setdefault(pod["metadata"]["uid"], wanted | {names.INSTANCE: _name(pod)})

    def _is_tampered(self, uid: str) -> bool:
        return uid in self._tampered or self._robots.now - self._restored_at.get(uid, -math.inf) < FOLLOWS

    def _restored(self, pod: Object | None) -> None:
        uid = pod["metadata"]["uid"] if pod is not None else ""
        if pod is not None and uid in self._tampered and self._tampered[uid].items() <= _labels(pod).items():
            del self._tampered[uid]
            self._restored_at[uid] = self._robots.now

    def _ended_by_monitor(self, pod: Object, by: str) -> None:
        """No understudy that never failed is deleted, except one that was claimed, since it cannot be given back, and one that is to leave
        its node."""
        found = self._robots.running.get(pod["metadata"]["uid"])
        if found is None or found.harmed or not found.up or _claimed(pod) or names.SOURCE in _labels(pod):
            return
        if not self._stays(pod):
            return
        self._broken(f"{by} deletes {found.name}, which has never failed")

    def _owners(self, old: Object | None, new: Object | None) -> None:
        """No pod has two owners, and a used understudy is never free again."""
        if new is None:
            return
        controllers = [o for o in new["metadata"].get("ownerReferences") or [] if o.get("controller")]
        if len(controllers) != 1:
            self._broken(f"pod {_name(new)} has {len(controllers)} controllers")
        if old is None:
            return
        before, after = _labels(old), _labels(new)
        if claims.is_held(after) and not claims.is_held(before):
            self._broken(f"pod {_name(new)} was used and is free again")
        was, now = (item["metadata"].get("annotations") or {} for item in (old, new))
        if names.CLAIM not in was and names.CLAIM in now:
            self.claims += 1
        if names.CLAIM in was and was[names.CLAIM] != now.get(names.CLAIM):
            self._broken(f"pod {_name(new)} was claimed by {was[names.CLAIM]} and then by {now.get(names.CLAIM)}")
        if (was_of := claims.workload_of(before)) and was_of != claims.workload_of(after):
            self._broken(f"pod {_name(new)} was of {was_of} and then of {claims.workload_of(after)}")
        is_edited = claims.workload_of(before) == claims.workload_of(after)  # by somebody, before this write
        is_other = controllers and controllers[0]["name"] != claims.workload_of(after)
        if names.CLAIM in now and is_other and not (names.CLAIM in was and is_edited):
            self._broken(f"pod {_name(new)} is owned by {controllers[0]['name']} and of {claims.workload_of(after)}")

    def _gate(self, old: Object | None, new: Object) -> None:
        """Each commit is of the next epoch, no other write lowers it, and lets exactly the pod through that it names."""
        after = GateRecord.of(new)
        self.commands.see(_name(new).removesuffix("-gate"), after)
        through = gates.let_through(new)
        if through != self._named(after):
            self._broken(f"{_name(new)} lets {through} through and names {after.active!r}")
        if through and _name(new).removesuffix("-gate") in self.fenced:
            self._broken(f"{_name(new)} lets {through} through, and a user has fenced it")
        if old is not None:
            before = GateRecord.of(old)
            changed = self._control(old) != self._control(new)
            # The epoch of a gate that was created again may be raised: to that of the status, or beyond the one that a mux knows.
            if after.epoch < before.epoch or (changed and after.epoch != before.epoch + 1):
                self._broken(f"{_name(new)} went from epoch {before.epoch} to {after.epoch}")
            self.commits += changed
            if (driver := self._robots.running.get(before.active_uid)) is not None:
                driver.harmed = True  # what a fenced one did counts
            at = self.failed.get(before.active_uid, 0.0)
            if changed:
                self._stale(before, after, _name(new))
            noticed = self._robots.now - at >= GAP or before.active_uid in after.recovery
            if before.active_uid != after.active_uid and not noticed:
                self.failed.pop(before.active_uid, None)  # control went elsewhere before anybody could know
        routed = self._routed(_name(new).removesuffix("-gate"), through)
        if len(routed) > self.most_through:
            self._broken(f"{_name(new)} lets several through at once: {', '.join(routed)}")

    def _stale(self, before: GateRecord, after: GateRecord, gate: str) -> None:
        """No instance is fenced for a failure that is long over, unless the network had kept the request."""
        found, recovery = self._robots.running.get(before.active_uid), recoveries.beside(after.recovery)
        if found is None or before.active_uid == after.active_uid or recovery is None or recovery.planned:
            return
        if recovery.result != "Running":
            return  # the gate closes for a leak, whoever is healthy
        if self._robots.clocks_differ:
            return
        well_since, network = self._heard_since(found), self._robots.network
        pod = self._server.get("pods", found.place)
        is_well = (
            found.through
            and not self._is_tampered(found.uid)  # a new monitor knows no pod that has lost its labels
            and pod is not None
            and not leaving(pod)
            and well_since > recovery.moments.get("detected", 0.0)
        )
        lasts = self._robots.now - well_since
        if is_well and lasts >= STALE and not network.carries_late and recovery.switchover is None:
            self._broken(f"{gate} fences {found.name} for a failure, and it is healthy again for {lasts:.1f} s")

    def _heard_since(self, found: Running) -> float:
        """Since when every monitor can know that an instance is healthy (Unix seconds)."""
        return max(found.well_since, found.through_since)

    def _named(self, record: GateRecord) -> tuple[str, ...]:
        """The instances that a gate names."""
        return (record.active,) if record.active else ()

    def _control(self, gate: Object) -> object:
        """What another epoch is needed for to change."""
        return GateRecord.of(gate).active_uid, gates.let_through(gate)

    def _routed(self, workload: str, through: tuple[str, ...]) -> list[str]:
        found = []
        for pod in self._server.items["pods"].values():
            labels = _labels(pod)
            if pod["metadata"]["uid"] in self._tampered:
                continue
            if claims.workload_of(labels) == workload and labels.get(names.INSTANCE) in through:
                found.append(_name(pod))
        return found

    def _created(self, pod: Object, by: str) -> None:
        """A pool never gets more free pods than it is to have, nor a workload more standbys, by what could be known."""
        self.creations += 1
        if not self._leads(by):
            self._stragglers.add(pod["metadata"]["uid"])
        labels = _labels(pod)
        pool, workload = labels[names.POOL], claims.workload_of(labels)
        same = [
            other
            for other in self._server.items["pods"].values()
            if _labels(other).get(names.POOL) == pool
            and claims.workload_of(_labels(other)) == workload
            and _labels(other)[names.TEMPLATE_HASH] == labels[names.TEMPLATE_HASH]
            and not _claimed(other)
            and _living(other)
            and self._stays(other)  # else it is replaced before it goes
        ]
        wanted = _size(self._server.items["fallbackpools"][(pod["metadata"]["namespace"], pool)])
        of_late = [size for since, size in self._sizes.get(pool, []) if self._robots.now - since < KNOWN]
        most = max([wanted, *of_late])
        if workload and self._refers(pod["metadata"]["namespace"], workload):
            most += 1  # what the referred controller makes is no standby, so one in control doesn't count
        elif workload and (
            names.REPLACES in (pod["metadata"].get("annotations") or {})
            or any(
                self._is_outdated(other, deleted=True) or (self._is_of(workload, other) and not self._stays(other))
                for other in [*self._server.items["pods"].values(), *self._gone_of_late()]
            )
        ):
            most += 1  # one that is to go when there is another
        most += sum(other["metadata"]["uid"] in self._stragglers for other in same)
        if len(same) > most:
            whose = f"pool {pool}" + (f" has standbys of {workload}" if workload else " has free pods")
            self._broken(f"{whose}, {len(same)} of them instead of {most}: {', '.join(map(_name, same))}")

    def _gone_of_late(self) -> list[Object]:
        return [pod for when, pod in self._gone if self._robots.now - when < KNOWN]

    # -- whenever what reaches a robot changes ----------------------------------------------------------------------

    def routed(self, robot: str) -> None:
        """No two pods reach a robot at once, but for what is left of one whose object is gone, and for nodes that enforce old gates."""
        self.drivers.routed(robot)
        record = gates.record(self._server, robot)
        named = record.active_uid if record is not None else ""
        for one in self._heard(robot):
            # As a StatefulSet's successor of the pod that the record names, since the gate selects by name. It may be ended as a leak.
            one.harmed |= one.uid != named
        found = [r for r in self._heard(robot) if r.exists]
        excused = any(self._robots.nodes.is_late(r.node) or self._is_tampered(r.uid) for r in found)
        if len(found) > 1 and not excused:
            self._broken(f"{robot} is driven by {' and '.join(r.name for r in found)} at once")

    def _heard(self, robot: str) -> list[Running]:
        """The instances that a robot hears."""
        return [r for r in self._robots.running.values() if r.robot == robot and r.through]

    def started(self, workload: str, uid: str, place: tuple[str, str]) -> None:
        """A monitor starts the processes of a pod: it must be the monitor's own."""
        pod = self._server.get("pods", place)
        if pod is not None and pod["metadata"]["uid"] == uid and claims.workload_of(_labels(pod)) != workload:
            self._broken(f"{workload} starts {place[1]}, which is of {claims.workload_of(_labels(pod)) or 'nobody'}")

    # -- once all is calm -------------------------------------------------------------------------------------------

    def unrest(self) -> list[str]:
        """What isn't as it should be in the end; nothing where every robot is driven and every pod belongs somewhere."""
        return [*self._undriven(), *self._unended(), *self._unfilled(), *self._leaked()]

    def _undriven(self) -> Iterator[str]:
        for _, workload in sorted(self._server.items["robotworkloads"]):
            gate = gates.record(self._server, workload)
            found = self._robots.running.get(gate.active_uid) if gate is not None else None
            if found is None or not found.through:
                yield f"{workload} isn't driven"

    def _unended(self) -> Iterator[str]:
        """Recoveries that dependents of a workload consider active, and that no monitor continues."""
        for (_, workload), item in sorted(self._server.items["robotworkloads"].items()):
            gate = gates.record(self._server, workload)
            found = recoveries.beside(gate.recovery) if gate is not None else None
            if found is None:
                continue
            status = RobotWorkloadStatus.model_validate(item.get("status") or {})
            if recoveries.under_way(Committed.of(found), recoveries.listed_recoveries(status.recoveries or [])):
                yield f"recovery {found.id} stands beside the gate of {workload} as though it were under way"

    def _unfilled(self) -> Iterator[str]:
        pods = self._server.items["pods"].values()
        for (_, pool), item in sorted(self._server.items["fallbackpools"].items()):
            mine = [pod for pod in pods if _labels(pod).get(names.POOL) == pool and _living(pod) and not _claimed(pod)]
            spec = item["spec"]
            if spec["readiness"] == "Uninitialized":
                free = [pod for pod in mine if claims.is_held(_labels(pod))]
                if len(free) != pool_size.size(item):
                    yield f"pool {pool} has {len(free)} free pods instead of {pool_size.size(item)}"
                yield from (f"pod {_name(pod)} isn't ready" for pod in free if not kube_objects.ready(pod))
                yield from self._misjudged(item, len(free))
                continue
            yield from self._misjudged(item, len(self._waiting(mine)))
            for namespace, workload in sorted(self._server.items["robotworkloads"]):
                standing = [pod for pod in mine if claims.workload_of(_labels(pod)) == workload]
                wanted = spec["perWorkload"]
                if self._refers(namespace, workload):
                    wanted += sum(pod["metadata"]["uid"] in self._in_control() for pod in standing)
                # Where one of a new template never gets up, the one before it stays; and where that is the workload's own, one more.
                if any(self._is_of(workload, pod) and not kube_objects.ready(pod) for pod in self._waiting(mine)):
                    wanted = max(wanted, min(len(standing), wanted + 1))
                waiting = [pod for pod in self._waiting(mine) if claims.workload_of(_labels(pod)) == workload]
                beside = [pod for pod in waiting if leaving_nodes.of(pod) in self._driven_from(workload)]
                if any(self._is_of(workload, pod) for pod in beside):
                    # A standby elsewhere stays beside it: the next own pod may be placed there again.
                    wanted = max(wanted, min(len(standing), wanted + 1))
                # None is moved while one of a new template never gets up.
                rest = len(beside) == len(waiting) and all(self._stands_by(pod) for pod in waiting)
                if waiting and rest and self._could_move(waiting):
                    yield f"every standby of {workload} in pool {pool} is on the node of the active instance"
                if len(standing) != wanted and all(self._stands_by(pod) for pod in standing):
                    yield f"pool {pool} has {len(standing)} pods of {workload} instead of {wanted}"
                yield from (f"pod {_name(pod)} isn't up" for pod in standing if not self._up(pod))
            if all(self._stands_by(pod) for pod in self._waiting(mine)):
                yield from self._outdated(self._own())

    def _driven_from(self, workload: str) -> set[str]:
        """The node of a workload's active instance."""
        in_control, pods = self._in_control(), self._server.items["pods"].values()
        found = (pod for pod in pods if pod["metadata"]["uid"] in in_control)
        return {leaving_nodes.of(pod) for pod in found if claims.workload_of(_labels(pod)) == workload}

    def _could_move(self, standbys: Sequence[Object]) -> bool:
        """Whether another node accepts one of these standbys on the active instance's node, and none was tried in vain."""
        places = {leaving_nodes.of(pod) for pod in standbys}
        others = [node for node in self._server.items["nodes"].values() if _name(node) not in places]
        tried = any(names.NOT_MOVED in kube_objects.notes(pod) for pod in standbys)
        return not tried and any(not leaving_nodes.is_leaving(node) for node in others)

    def _own(self) -> list[Object]:
        """The pods of workloads' own controllers that wait, in whoever's place."""
        in_control, pods = self._in_control(), self._server.items["pods"].values()
        made = [pod for pod in pods if _labels(pod).get(names.SOURCE) == "workload" and _living(pod)]
        return [pod for pod in made if pod["metadata"]["uid"] not in in_control]

    def _outdated(self, waiting: Sequence[Object]) -> Iterator[str]:
        """The pods of workloads' own controllers that wait with another template than these have by now."""
        yield from (f"pod {_name(pod)} waits with an old template" for pod in waiting if self._is_outdated(pod))

    def _is_of(self, workload: str, pod: Object) -> bool:
        """Whether a workload's own controller has made a pod."""
        return claims.workload_of(_labels(pod)) == workload and _labels(pod).get(names.SOURCE) == "workload"

    def _stays(self, pod: Object) -> bool:
        """Whether no operator may take a pod's node for one that is to be emptied."""
        return self._emptied.get(leaving_nodes.of(pod), 0.0) < self._robots.now

    def _is_outdated(self, pod: Object, *, deleted: bool = False) -> bool:
        """Whether a pod of a workload's own controller has another template than that one has by now. With ``deleted``, or had at last."""
        owner = controller_of(pod)
        if owner is None or owner["kind"] != "ReplicaSet":
            return False
        place = pod["metadata"]["namespace"], owner["name"]
        live = self._server.get("replicasets", place)
        if live is None and not (deleted and place in self._deleted_templates):
            return False
        last = _template(live) if live is not None else self._deleted_templates[place]
        return _labels(pod).get(names.TEMPLATE_HASH) != last

    def _waiting(self, made: Sequence[Object]) -> list[Object]:
        """The pods that wait: those that a pool made, and those that its workloads' own controllers made since one of it drives."""
        in_control = self._in_control()
        driven = {claims.workload_of(_labels(pod)) for pod in made if pod["metadata"]["uid"] in in_control}
        own = [
            pod
            for (namespace, _), pod in self._server.items["pods"].items()
            if claims.workload_of(_labels(pod)) in driven
            and _labels(pod).get(names.SOURCE) == "workload"
            and _living(pod)
            if not self._refers(namespace, claims.workload_of(_labels(pod)))
        ]
        return [pod for pod in made if pod["metadata"]["uid"] not in in_control] + own

    def _misjudged(self, pool: Object, there: int) -> Iterator[str]:
        """Whether a former leader's word on a pool is the last one."""
        if (reported := (pool.get("status") or {}).get("replicas")) != there:
            yield f"pool {_name(pool)} says that it has {reported} pods, and has {there}"

    def _stands_by(self, pod: Object) -> bool:
        found = self._robots.running.get(pod["metadata"]["uid"])
        return found is not None and found.stands_by

    def _up(self, pod: Object) -> bool:
        """Whether its application is healthy, or never will be."""
        found = self._robots.running.get(pod["metadata"]["uid"])
        return found is not None and (found.stands_by or found.broken)

    def _refers(self, namespace: str, workload: str) -> bool:
        return "workloadRef" in self._server.items["robotworkloads"][(namespace, workload)]["spec"]

    def _in_control(self) -> set[str]:
        return {GateRecord.of(gate).active_uid for _, gate in gates.everyone(self._server)}

    def _leaked(self) -> Iterator[str]:
        in_control = self._in_control()
        for _, pod in sorted(self._server.items["pods"].items()):
            owner = controller_of(pod)
            if leaving(pod):
                yield f"pod {_name(pod)} is on its way out"
            elif pod["metadata"]["uid"] in in_control or claims.is_held(_labels(pod)):
                continue
            elif pod["metadata"]["uid"] in self.failed and _living(pod):
                yield f"pod {_name(pod)} has failed in control, and nobody deletes it"
            elif _claimed(pod):
                yield f"pod {_name(pod)} was claimed, isn't in control, and nobody deletes it"
            elif owner is not None and owner["kind"] == "ReplicaSet" and not self._standbys(pod):
                yield f"pod {_name(pod)} is neither in control nor a standby"
        for uid, found in self._robots.running.items():
            if not found.ended and not found.exists:
                yield f"processes of {found.name} ({uid}) live on"

    def _standbys(self, pod: Object) -> bool:
        """Whether what the workload's own controller makes is a standby, or has ended and is only a record. What a referred one
        makes is its own business.
        """
        if names.SOURCE not in _labels(pod):
            return True
        pools = self._server.items["fallbackpools"].values()
        ended = (pod.get("status") or {}).get("phase") in ("Failed", "Succeeded")
        return ended or any(pool["spec"]["readiness"] != "Uninitialized" for pool in pools)


def _name(item: Object) -> str:
    found: str = item["metadata"]["name"]
    return found


def _template(replicaset: Object) -> str | None:
    return _labels(replicaset["spec"]["template"]).get(names.TEMPLATE_HASH)


def _labels(item: Object) -> dict[str, str]:
    return item["metadata"].get("labels") or {}


def _size(pool: Object) -> int:
    spec = pool["spec"]
    if "sizing" in spec:  # how many exactly is said after they were made
        most: int = spec["sizing"]["max"]
        return most
    found: int = spec.get("replicas", spec.get("perWorkload", 0))
    return found


def _claimed(pod: Object) -> bool:
    return names.CLAIM in (pod["metadata"].get("annotations") or {})


def leaving(pod: Object) -> bool:
    """Whether somebody has deleted a pod that is there still."""
    return "deletionTimestamp" in pod["metadata"]


def _deleted(old: Object, new: Object | None) -> bool:
    return not leaving(old) and (new is None or leaving(new))


def _living(pod: Object) -> bool:
    return not leaving(pod) and (pod.get("status") or {}).get("phase") not in ("Failed", "Succeeded")

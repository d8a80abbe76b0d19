"""The interface that every kind of gate implements.

A gate decides which instance's outputs reach a robot. Each workload has one. Its commit point is one object of the Kubernetes API, the gate
object, and the annotations of that object hold the record: who is in control, the epoch, and the recovery that made the last commit. The
record is the same for every kind, so it can be read without knowing the kind. Every change is one merge patch with the resourceVersion of
the record on which it was decided, so that the API server refuses one of two writers.

A kind (:class:`GateKind`) defines what the gate object does with the instances that the record names, which further objects the gate needs,
and how to prove that it works (:class:`Proof`). A kind that routes at the robot does so by orders that carry the epoch of the record.

To add a kind, name it in ``Gate.kind`` (api/kinds/robot_workload.py), and add a module of that name in snake case to the folder kinds/,
with the kind as its ``GATE``.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Protocol

from understudy.api import names
from understudy.api.base import OBJECT_NAME_PATTERN
from understudy.api.kinds.robot_workload import Output
from understudy.api.whole_numbers import whole_number
from understudy.kube.client import Client, Object, Resource

LONGEST_LABEL = 63
"""Most characters of a label's value."""


@dataclass(frozen=True)
class GateRecord:
    """The record in a gate object's annotations, for every kind of gate."""

    epoch: int
    """Grows by one with every commit. A command with an older epoch is refused."""
    active: str
    """The pod in control; empty while the gate is closed."""
    active_uid: str
    recovery: str
    """JSON of the recovery that made the last commit, or empty."""
    version: str
    """The resourceVersion of the gate object."""
    admitted: str = ""
    """The standby that may reach the robot in addition to the pod in control, for the reflex."""
    admitted_uid: str = ""
    let_through: str = ""
    """JSON of the pods that the gate let through of late, or empty."""
    fenced: int = 0
    """The generation of the RobotWorkload since which a user has fenced the robot; 0 if nobody has."""

    @classmethod
    def of(cls, gate: Object) -> GateRecord:
        """Read the record of a gate object. Whoever may write the gate may have written names that no pod has: they name nobody."""
        annotations = gate["metadata"].get("annotations") or {}
        return cls(
            epoch=whole_number(annotations.get(names.EPOCH, "")) or 0,
            active=_pod_name(annotations.get(names.ACTIVE, "")),
            active_uid=annotations.get(names.ACTIVE_UID, ""),
            recovery=annotations.get(names.RECOVERY, ""),
            version=gate["metadata"]["resourceVersion"],
            admitted=_pod_name(annotations.get(names.ADMITTED, "")),
            admitted_uid=annotations.get(names.ADMITTED_UID, ""),
            let_through=annotations.get(names.LET_THROUGH, ""),
            fenced=whole_number(annotations.get(names.FENCED, "")) or 0,
        )


def _pod_name(text: str) -> str:
    """Return a name that a label can have too, which a gate selects by; empty if the text is none."""
    return text if len(text) <= LONGEST_LABEL and re.fullmatch(OBJECT_NAME_PATTERN, text) else ""


@dataclass(frozen=True)
class Reach:
    """With whom the instances of a workload may exchange packets, besides its monitor and its discovery server."""

    peers: tuple[Object, ...] = ()
    """Pods, as the peers of a NetworkPolicy. Empty: the pods of the workload's own namespace."""
    robots: tuple[str, ...] = ()
    """Addresses outside the cluster, as CIDRs."""
    reference: Mapping[str, Any] | None = None
    """The pod selector of a referenced controller, whose pods are instances before they have the operator's labels."""
    apiservers: tuple[tuple[str, int], ...] = ()
    """Addresses and ports of the API server. Only for instances whose agents freeze them while nobody answers."""


Report = tuple[Literal["True", "False", "Unknown"], str, str]
"""Status, reason and message of a condition."""


@dataclass(frozen=True)
class OwnSwitch:
    """A switch that somebody at the gate has made by itself."""

    to: str
    """The name of the instance that is let through since."""
    is_idle: bool
    """Whether nothing of that instance was let through for a while."""
    active_sends: bool
    """Whether the active instance is heard there, so that it would drive if it were let through again."""


class Proof(Protocol):
    """Evidence of whose packets pass the gate, observed at its far side and not read from the API."""

    leak_hint: str = ""
    """A sentence: the likely cause if packets of an instance pass that the gate does not name, and what to do."""
    block_hint: str = ""
    """A sentence: what to look for if packets of an instance do not pass the gate, although it names that pod."""

    def trust(self, uid: str, key: bytes) -> None:
        """Count the packets of a pod that its agent authenticates with a key, which a session with the agent provides."""

    def trust_unsigned(self, uid: str) -> None:
        """Count the packets of a pod although nothing authenticates them, because its agent is too old."""

    def recognizes(self, uid: str) -> bool:
        """Return whether packets of a pod would count. If they would not, their absence shows nothing."""
        return True

    def last(self, uid: str) -> float | None:
        """Return when a packet of a pod last passed the gate, in Unix seconds; None if none did."""

    def heard_since(self, time: float) -> Sequence[str]:
        """Return the UIDs of all pods of which a packet has passed the gate since a time (Unix seconds)."""
        return ()

    async def wait(self, uid: str, after: float) -> float:
        """Wait for a packet of a pod, and return when the first one at or after a time passed the gate.

        A recovery waits for it, so both times are of the process's clock (understudy.clock).
        """

    def deciding(self) -> None:
        """Note that this monitor begins to commit what it has decided. The commit may take long, and something may happen meanwhile."""
        return

    def committed(self, epoch: int) -> None:
        """Note that this monitor has just committed the gate object at an epoch."""
        return

    def carried_out(self, epoch: int) -> int:
        """Return the epoch that somebody at the gate has carried out, if that is why the present one is refused there; 0 if it is not.

        That one is older, or was used before: somebody deleted the gate object.
        """
        return 0

    def own_switch(self, active: str) -> OwnSwitch | None:
        """Return the switch to another instance than the active one that somebody at the gate has made by itself; None if there is none."""
        return None

    def is_back(self, active: str) -> bool:
        """Return whether somebody at the gate lets the active instance through again, after having switched to another one by itself."""
        return False

    def switched(self, active: str) -> tuple[str, float, float] | None:
        """Return whom somebody at the gate has put in control instead of the active instance, when that was last heard, and when the other
        one was first let through, in Unix seconds. None if nobody there has switched.
        """
        return None

    @property
    def is_away(self) -> bool:
        """Whether the robot cannot be reached: somebody at the gate must report, and does not."""
        return False

    def reported(self, active: str) -> Report | None:
        """Return status, reason and message of the condition GateEnforced, if somebody at the gate reports whom it lets through.

        ``active`` is whom the gate object names. None if only packets show it.
        """
        return None


class GateKind(ABC):
    """A kind of gate. It has no state; the gate objects hold the record."""

    kind: ClassVar[str]
    """Value of ``spec.gate.kind``."""
    object_kind: ClassVar[str]
    """Kind of the gate object."""
    resource: ClassVar[Resource]
    """The resource of the gate object. The operator watches the objects of this resource that it has created."""
    page: ClassVar[str]
    """The page of the docs about what the kind needs."""
    is_at_robot: ClassVar[bool] = False
    """As ``Gate.is_at_robot``: a mux forwards the outputs, so the network need not enforce anything."""
    fence_hint: ClassVar[str] = ""
    """A sentence: what whoever closes a gate by hand must know, besides that it is closed; empty if nothing."""

    # -- What users read ------------------------------------------------------------------------------------------------

    @abstractmethod
    def how_it_switches(self, workload: str) -> str:
        """Return sentences: what the gate of a workload is, and how a change of it takes effect."""

    @abstractmethod
    def words_for_admitted(self, standby: str) -> str:
        """Return a sentence: what it means that the record of a gate admits a standby."""

    def not_covered(self, outputs: Sequence[Output]) -> Sequence[str]:
        """Return sentences: what gates of this kind do not cover for these outputs of a workload."""
        return ()

    # -- What the gate object does ------------------------------------------------------------------------------------

    @abstractmethod
    def routing(self, workload: str, active: str, admitted: str = "") -> Object:
        """Return merge patch fields that let these instances through and nobody else. Without ``active`` the gate is closed."""

    @abstractmethod
    def let_through(self, gate: Object) -> tuple[str, ...]:
        """Return the names of the instances that a gate object lets through, whatever its record says."""

    @abstractmethod
    def routing_repair(self, gate: Object, workload: str, active: str, admitted: str = "") -> Object:
        """Return merge patch fields after which a gate object lets these instances through and nobody else; empty if it does."""

    @abstractmethod
    def ungateable(self, template: Mapping[str, Any]) -> str:
        """Return why this kind cannot gate the outputs of pods of a template, beginning with the field; empty if it can."""

    @abstractmethod
    def ungated(self, pod: Object) -> Mapping[str, tuple[str, ...]]:
        """Return the networks of a pod that a gate of this kind does not control, as its object shows them: each with its known addresses.

        A template with such networks is refused. The pod may exist nevertheless: its controller's template was changed later, or an
        admission webhook changed the pod.
        """

    # -- What the operator creates ------------------------------------------------------------------------------------

    @abstractmethod
    def closed(self, workload: str, reach: Reach, *, epoch: int, fenced: int = 0) -> Object:
        """Return a gate object that lets nobody through. After it is created, only the monitor commits to it.

        ``epoch`` is the last one known, so that the commits of a gate that somebody deleted do not become valid again. ``fenced`` is as in
        its record.
        """

    @abstractmethod
    def spec_repair(self, gate: Object, workload: str, reach: Reach) -> Object:
        """Return merge patch fields that restore the gate object except routing and record; empty if nothing differs."""

    @abstractmethod
    def companions(self, workload: str, reach: Reach) -> list[tuple[Resource, Object]]:
        """Return the other objects that the gate of a workload needs, each with its resource."""

    @abstractmethod
    def instance_rules(self, workload: str, reach: Reach, pools: Sequence[str] = ()) -> Object:
        """Return the rules of a NetworkPolicy for instances that are not in control. Pods of ``pools`` are no peers of them."""

    # -- How it is proven -----------------------------------------------------------------------------------------------

    @abstractmethod
    async def proof(self) -> Proof:
        """Start to collect evidence of whose packets pass the gate, in the monitor's pod. Raises OSError."""

    # -- The same for every kind ----------------------------------------------------------------------------------------

    def repair(
        self,
        gate: Object,
        reach: Reach,
        *,
        owner: Object,
        labels: Mapping[str, str],
        epoch: int = 0,
        paused: bool = False,
    ) -> Object | None:
        """Return a merge patch that restores a gate object; None if nothing differs.

        The record belongs to the monitor. A commit writes record and routing at once, so a routing that differs from the record is
        somebody else's: it is restored, also while no monitor runs. While the workload is paused, a user may choose whom the gate lets
        through, and only a routing that no commit writes is restored, because it may let any pod of the namespace through. ``owner`` is
        the RobotWorkload. ``epoch`` is the last one that the monitor has reported: if somebody lowered that of the gate, agents would
        refuse the monitor. The patch is valid for this version of the gate object only.
        """
        metadata, workload = gate["metadata"], owner["name"]
        patch = self.spec_repair(gate, workload, reach)
        record = GateRecord.of(gate)
        if not paused or self.malformed(gate, workload):
            patch = _merged(patch, self.routing_repair(gate, workload, record.active, record.admitted))
        fields: Object = {}
        present = metadata.get("labels") or {}
        if missing := {key: value for key, value in labels.items() if present.get(key) != value}:
            fields["labels"] = missing
        owners = metadata.get("ownerReferences") or []
        if owner not in owners:
            fields["ownerReferences"] = [*(one for one in owners if one.get("uid") != owner["uid"]), owner]
        if record.epoch < epoch:
            fields["annotations"] = {names.EPOCH: str(epoch)}
        return (patch | ({"metadata": fields} if fields else {})) or None

    def malformed(self, gate: Object, workload: str) -> bool:
        """Whether a gate object has a routing that no commit writes, whichever instances it names.

        It may let through more than one pod in control and one standby, or pods that it does not name.
        """
        through = self.let_through(gate) or ("",)
        return len(through) > 2 or bool(self.routing_repair(gate, workload, *through))

    def secrets(self, workload: str) -> tuple[str, ...]:
        """Return the names of the Secrets that a monitor reads for this kind."""
        return ()

    def monitor_rules(self, workload: str) -> list[Object]:
        """Return the RBAC rules that let a monitor read and commit its workload's gate, and no other."""
        return [
            {
                "apiGroups": [self.resource.group],
                "resources": [self.resource.plural],
                "verbs": ["get", "list", "watch", "patch"],
                "resourceNames": [names.gate(workload)],
            }
        ]

    def commitment(
        self,
        workload: str,
        *,
        over: GateRecord,
        active: str = "",
        active_uid: str = "",
        recovery: str = "",
        waits_for: str = "",
        let_through: str = "",
        fenced: int = 0,
    ) -> Object:
        """Return the merge patch that names the one pod that may reach the robot (none if ``active`` is empty).

        It applies to exactly the record ``over``. One atomic write fences the old pod and an admitted standby, and routes the new pod.
        ``waits_for`` is the shared pool for whose pod the workload waits. ``let_through`` is the JSON of the pods that were let through
        of late, this one included; empty to keep the list. ``fenced`` is the generation since which a user has fenced the robot; a gate
        that is opened forgets it.
        """
        pinned = {names.LET_THROUGH: let_through} if let_through else {}
        fence: Object = {names.FENCED: str(fenced)} if fenced else {names.FENCED: None} if active else {}
        return {
            "metadata": {
                "resourceVersion": over.version,
                "labels": {names.WAITS_FOR: waits_for or None},
                "annotations": {
                    names.EPOCH: str(over.epoch + 1),
                    names.ACTIVE: active,
                    names.ACTIVE_UID: active_uid,
                    names.RECOVERY: recovery,
                    names.ADMITTED: "",
                    names.ADMITTED_UID: "",
                    **pinned,
                    **fence,
                },
            },
            **self.routing(workload, active),
        }

    def noting(self, *, over: GateRecord, recovery: str, waits_for: str = "") -> Object:
        """Return the merge patch that changes what the record says of the recovery of the last commit, such as that it has ended.

        It applies to exactly the record ``over``. ``recovery`` is the JSON of the recovery from then on. Control does not change, so the
        epoch stays. ``waits_for`` is as for a commitment.
        """
        return {
            "metadata": {
                "resourceVersion": over.version,
                "labels": {names.WAITS_FOR: waits_for or None},
                "annotations": {names.RECOVERY: recovery},
            }
        }

    def overtaking(self, *, over: GateRecord, recovery: str) -> Object:
        """Return the merge patch after which the API server refuses every commit over the record ``over`` that still reaches it.

        ``recovery`` is the id of the recovery that sent such a commit. Control does not change, so the epoch stays.
        """
        return {"metadata": {"resourceVersion": over.version, "annotations": {names.OVERTAKEN: recovery}}}

    def raising(self, *, over: GateRecord, epoch: int) -> Object:
        """Return the merge patch that gives the gate a greater epoch and changes nothing else.

        It applies to exactly the record ``over``.
        """
        return {"metadata": {"resourceVersion": over.version, "annotations": {names.EPOCH: str(epoch)}}}

    def admission(
        self, workload: str, *, over: GateRecord, admitted: str, admitted_uid: str, let_through: str = ""
    ) -> Object:
        """Return the merge patch that lets a standby through in addition to the pod in control (none if ``admitted`` is empty).

        It applies to exactly the record ``over``. Control does not change, so the epoch stays. ``let_through`` is as for a commitment.
        Raises ValueError if the gate is closed, because then nobody may reach the robot.
        """
        pinned = {names.LET_THROUGH: let_through} if let_through else {}
        if not over.active:
            raise ValueError(f"{self.object_kind} {names.gate(workload)} is closed: no standby can be let through")
        metadata = {
            "resourceVersion": over.version,
            "annotations": {names.ADMITTED: admitted, names.ADMITTED_UID: admitted_uid, **pinned},
        }
        return {"metadata": metadata, **self.routing(workload, over.active, admitted)}

    async def write(self, client: Client, namespace: str, workload: str, patch: Object) -> Object:
        """Write one of these patches and return the new gate object. Raises ApiError, with status 409 if another write came first."""
        return await client.patch(self.resource, namespace, names.gate(workload), patch)


def _merged(patch: Object, other: Object) -> Object:
    """Return a merge patch that has the fields of both."""
    both = {key: _merged(patch[key], other[key]) for key in patch.keys() & other.keys() if isinstance(patch[key], dict)}
    return {**patch, **other, **both}

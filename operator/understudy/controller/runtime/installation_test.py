"""Checks, for ``helm test`` in the operator's namespace, whether the installation works.

``understudy verify`` has its own ServiceAccount, whose name ends like a monitor's, so that the admission policy applies
to it too. It changes nothing: it creates and deletes objects only as dry runs.
"""

from __future__ import annotations

import argparse
import asyncio
import copy
import os
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

from understudy.api.base import API_VERSION, VERSION
from understudy.api.schema.definitions import definitions
from understudy.controller.runtime.process import LEASE
from understudy.kube.client import (
    CRDS,
    DEPLOYMENTS,
    FAILURES,
    LEASES,
    PODS,
    WORKLOADS,
    Access,
    ApiError,
    Client,
    Object,
)
from understudy.kube.kubeconfig import default_access

WITHIN = 60.0
"""Seconds within which every check must pass, because the installation may have finished a moment ago."""

_AGAIN = 2.0
_LED = 60.0
"""Maximum age, in seconds, of the leader's last renewal.

The leader renews every 2 s, and the clocks of the two nodes may differ.
"""

_WORKLOAD: Object = {
    "apiVersion": API_VERSION,
    "kind": "RobotWorkload",
    "metadata": {"name": "verified"},
    "spec": {
        "workloadRef": {"kind": "Deployment", "name": "verified"},
        "outputs": [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}],
        "failurePolicyRef": {"name": "verified"},
    },
}


@dataclass(frozen=True)
class Place:
    """The installation to check."""

    namespace: str
    operator: str
    """Name of the operator's Deployment."""
    pod: str
    """Name of the pod that runs the checks."""
    admission: bool
    """Whether the admission policy is installed."""


def operator_problem(deployment: Object, lease: Object | None, now: float) -> str | None:
    """Return why the operator is not working, or None."""
    wanted = deployment["spec"].get("replicas", 1)
    status = deployment.get("status") or {}
    available = status.get("availableReplicas", 0)
    if status.get("observedGeneration", 0) < deployment["metadata"]["generation"] or available < wanted or not wanted:
        return f"{available} of {wanted} replicas are available"
    spec = (lease or {}).get("spec") or {}
    if not spec.get("holderIdentity") or not spec.get("renewTime"):
        return f"no replica is the leader: Lease {LEASE} has no holder"
    silent = now - datetime.fromisoformat(spec["renewTime"]).timestamp()
    if silent > _LED:
        return f"{spec['holderIdentity']} is the leader, but has not renewed Lease {LEASE} for {silent:.0f} s"
    return None


def definition_problem(found: Object, wanted: Mapping[str, object]) -> str | None:
    """Return how a CustomResourceDefinition in the cluster differs from the one of this version, or None."""
    conditions = (found.get("status") or {}).get("conditions") or []
    if not any(c["type"] == "Established" and c["status"] == "True" for c in conditions):
        return "it is not established"
    versions = {version["name"]: version for version in found["spec"]["versions"]}
    if VERSION not in versions or not versions[VERSION]["served"]:
        return f"{VERSION} is not served, but {', '.join(versions)}"
    [mine] = wanted["spec"]["versions"]  # type: ignore[index]
    if versions[VERSION]["schema"] != mine["schema"]:
        return "its schema belongs to another version of Understudy. With crds.install=false, apply the definition of this version"
    return None


async def _operator(client: Client, place: Place) -> str | None:
    deployment = await client.get(DEPLOYMENTS, place.namespace, place.operator)
    return operator_problem(deployment, await client.find(LEASES, place.namespace, LEASE), time.time())


async def _definitions(client: Client, place: Place) -> str | None:
    for wanted in definitions().values():
        name = wanted["metadata"]["name"]
        found = await client.find(CRDS, None, name)
        problem = "it does not exist" if found is None else definition_problem(found, wanted)
        if problem is not None:
            return f"{name}: {problem}"
    return None


async def _accepted(client: Client, place: Place) -> str | None:
    refusal = await _refusal(client, place, _WORKLOAD)
    return None if refusal is None else f"a valid RobotWorkload is rejected: {refusal}"


async def _refused(client: Client, place: Place) -> str | None:
    unknown, neither = copy.deepcopy(_WORKLOAD), copy.deepcopy(_WORKLOAD)
    unknown["spec"]["outptus"] = []
    del neither["spec"]["workloadRef"]
    for wrong, word in ((unknown, "outptus"), (neither, "workloadRef")):
        refusal = await _refusal(client, place, wrong)
        if refusal is None or word not in refusal:
            return f"a RobotWorkload with an invalid spec ({word}) is not rejected for that reason: {refusal or 'it is accepted'}"
    return None


async def _refusal(client: Client, place: Place, workload: Object) -> str | None:
    """Return why the API server would reject a RobotWorkload, or None."""
    params = {"dryRun": "All", "fieldValidation": "Strict"}
    try:
        await client.request("POST", WORKLOADS.path(place.namespace), params=params, body=workload)
    except ApiError as error:
        if error.passing or error.status not in (400, 422):  # a 403, for example, is not about the content
            raise
        return error.message
    return None


async def _held_back(client: Client, place: Place) -> str | None:
    """Return a problem if a monitor's account could delete a pod of another workload.

    Its Role would permit that, so the admission policy must reject it.
    """
    try:
        await client.request("DELETE", PODS.path(place.namespace, place.pod), body={"dryRun": ["All"]})
    except ApiError as error:
        if error.status == 403 and "may delete only pods labelled" in error.message:
            return None
        raise
    return "a monitor could delete a pod of another workload: the ValidatingAdmissionPolicy is not in effect"


Check = Callable[[Client, Place], Awaitable[str | None]]

_CHECKS: dict[str, Check] = {
    "the operator is running": _operator,
    "the three kinds match this version": _definitions,
    "a RobotWorkload is accepted": _accepted,
    "invalid RobotWorkloads are rejected": _refused,
}


async def verify(access: Access, place: Place) -> dict[str, str | None]:
    """Return all checks, each with the problem that remains after ``WITHIN`` seconds, or None."""
    checks = dict(_CHECKS) | ({"monitors can delete only their own pods": _held_back} if place.admission else {})
    end = time.monotonic() + WITHIN
    async with Client(access) as client:
        while True:
            found = {what: await _problem(check, client, place) for what, check in checks.items()}
            if not any(found.values()) or time.monotonic() >= end:
                return found
            await asyncio.sleep(_AGAIN)


async def _problem(check: Check, client: Client, place: Place) -> str | None:
    try:
        return await check(client, place)
    except FAILURES as error:
        return str(error) or type(error).__name__


def main(argv: Sequence[str]) -> int:
    """Print the results of the checks, and return the exit status."""
    parser = argparse.ArgumentParser(
        prog="understudy verify",
        description="Checks from a pod whether this installation works. helm test uses this command. To check a cluster by hand, use "
        "understudy doctor.",
        epilog="Exit status: 0 if every check passes, 1 otherwise.",
    )
    parser.add_argument("--operator", required=True, metavar="NAME", help="name of the operator's Deployment")
    parser.add_argument(
        "--no-admission", action="store_true", help="do not check the admission policy, because it is not installed"
    )
    options = parser.parse_args(argv)
    place = Place(
        os.environ["UNDERSTUDY_NAMESPACE"], options.operator, os.environ["POD_NAME"], not options.no_admission
    )
    found = asyncio.run(verify(default_access(), place))
    for what, problem in found.items():
        print(f"FAILED  {what}: {problem}" if problem else f"ok      {what}")
    return int(any(found.values()))

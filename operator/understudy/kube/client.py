"""A small asynchronous client of the Kubernetes API, for objects as plain dictionaries.

The monitor and the agent run beside every robot, so their memory matters. Importing the official client costs 14 MB for
models of kinds that are never used here; this client costs nothing beyond aiohttp. It is also on the path of a
failover: one persistent connection, one request, no conversion to models.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import random
import re
import socket
import ssl
from collections.abc import AsyncIterator, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import aiohttp

from understudy.kube.api_contact import ApiContact
from understudy.kube.decoding import decode, decode_each, decoded

Object = dict[str, Any]

SERVICE_ACCOUNT = Path("/var/run/secrets/kubernetes.io/serviceaccount")
PAGE = 250
"""Number of objects in a part of a list. A pod is about 10 kB, and only a part of it is kept."""
LIFETIME = (200, 300)
"""Bounds of the seconds after which a watch ends and starts again."""

SILENCE = 75.0
"""Seconds after which a silent watch counts as dead, although its connection may be alive: a proxy may have kept it open. The API server
sends a bookmark every minute."""

_KEEPALIVE = {"TCP_KEEPIDLE": 5, "TCP_KEEPINTVL": 3, "TCP_KEEPCNT": 3, "TCP_USER_TIMEOUT": 10_000}
"""Socket options with which the kernel ends a connection whose other side has vanished without a reset: within 5 + 3 * 3 seconds if
nothing is sent, and within 10,000 milliseconds otherwise. Without them, a watch would wait until the end of its lifetime."""

_TOKEN_LIFETIME = 60.0  # seconds between reads; the kubelet renews the file long before the token expires
_WEBHOOK = re.compile(r'failed calling webhook "([^"]+)"')
_BY_CONTENT = re.compile(r"(exceeded|failed) quota: |violates PodSecurity |is being terminated")
"""What is in refusals that depend on no account and no role."""
_UNKNOWN_CLIENT = (
    "the token is missing or not valid (that of a pod ends with the pod), or the API server has only just started"
)


class ApiError(Exception):
    """The API server refused a request: ``status`` is the HTTP status, ``reason`` is Kubernetes' reason.

    ``just_back`` says whether the server did not answer until a moment ago.
    """

    def __init__(self, status: int, reason: str, message: str, *, just_back: bool = False) -> None:
        super().__init__(f"{status} {reason}: {message}")
        self.status = status
        self.reason = reason
        self.message = message
        self.just_back = just_back

    @property
    def not_found(self) -> bool:
        """Whether the object does not exist."""
        return self.status == 404

    @property
    def conflict(self) -> bool:
        """Whether another writer came first (or the object already exists)."""
        return self.status == 409

    @property
    def passing(self) -> bool:
        """Whether the error does not depend on the request: the server was busy or failed.

        It may even have carried out the request.
        """
        return self.status == 429 or (self.status >= 500 and not self.malformed)

    @property
    def unauthenticated(self) -> bool:
        """Whether the server does not know who asks. This says nothing about the request, which was not carried out."""
        return self.status == 401

    @property
    def waking(self) -> bool:
        """Whether the server may not have loaded the accounts and roles yet, as for some time after its start.

        How long a server knows no client depends on its machine. A token that has become invalid looks the same.
        """
        if self.status != 403:
            return self.unauthenticated
        unknown_role = "RBAC: " in self.message and self.message.endswith("not found")
        return unknown_role or (self.just_back and not _BY_CONTENT.search(self.message))

    @property
    def final(self) -> bool:
        """Whether the server would refuse the same request again, as long as nothing else changes."""
        return not self.passing and not self.waking

    @property
    def malformed(self) -> bool:
        """Whether the server refuses to apply an object that does not fit its schema.

        The object has an unknown field or a duplicate entry. The API server answers 500 in this case
        (kubernetes/kubernetes#122480), and does so every time.
        """
        return self.status == 500 and self.message.startswith("failed to create typed patch object")

    @property
    def webhook(self) -> str:
        """The admission webhook that had to be asked and did not answer; empty for other errors.

        The API server answers 500 in this case if the webhook's failurePolicy is Fail, until the webhook answers again.
        """
        found = _WEBHOOK.search(self.message) if self.status >= 500 else None
        return found[1] if found else ""


NO_ANSWER = (aiohttp.ClientError, TimeoutError, OSError)
"""The errors of a request that the API server did not answer. It may have carried the request out."""

FAILURES = (ApiError, *NO_ANSWER)
"""All errors that a request raises."""


class Expired(Exception):
    """The watch's resourceVersion is too old (410 Gone): list again."""


@dataclass(frozen=True)
class Resource:
    """The place of a resource in the API."""

    group: str
    version: str
    plural: str

    @property
    def qualified(self) -> str:
        """The name as ``kubectl`` takes it, such as ``deployments.apps``."""
        return f"{self.plural}.{self.group}" if self.group else self.plural

    def path(self, namespace: str | None, name: str | None = None, subresource: str | None = None) -> str:
        """Return the URL path of the collection, an object or its subresource."""
        root = f"/apis/{self.group}/{self.version}" if self.group else f"/api/{self.version}"
        parts = [root]
        if namespace:
            parts += ["namespaces", namespace]
        parts.append(self.plural)
        if name:
            parts.append(name)
        if subresource:
            parts.append(subresource)
        return "/".join(parts)


EVICTION = "DeletionByTaintManager"
"""Reason in the condition DisruptionTarget of a pod that is deleted because its node is not ready or unreachable."""

PODS = Resource("", "v1", "pods")
POD_METRICS = Resource("metrics.k8s.io", "v1beta1", "pods")
_AGGREGATED = f"/apis/{POD_METRICS.group}/"
"""Paths that another server answers, behind the API server. Its answers and its silence say nothing about the API server."""
SERVICES = Resource("", "v1", "services")
ENDPOINT_SLICES = Resource("discovery.k8s.io", "v1", "endpointslices")
CONFIG_MAPS = Resource("", "v1", "configmaps")
SECRETS = Resource("", "v1", "secrets")
SERVICE_ACCOUNTS = Resource("", "v1", "serviceaccounts")
EVENTS = Resource("", "v1", "events")
NAMESPACES = Resource("", "v1", "namespaces")
NODES = Resource("", "v1", "nodes")
DEPLOYMENTS = Resource("apps", "v1", "deployments")
REPLICA_SETS = Resource("apps", "v1", "replicasets")
STATEFUL_SETS = Resource("apps", "v1", "statefulsets")
NETWORK_POLICIES = Resource("networking.k8s.io", "v1", "networkpolicies")
ROLES = Resource("rbac.authorization.k8s.io", "v1", "roles")
ROLE_BINDINGS = Resource("rbac.authorization.k8s.io", "v1", "rolebindings")
DISRUPTION_BUDGETS = Resource("policy", "v1", "poddisruptionbudgets")
LEASES = Resource("coordination.k8s.io", "v1", "leases")
CRDS = Resource("apiextensions.k8s.io", "v1", "customresourcedefinitions")
WORKLOADS = Resource("understudy.dev", "v1alpha1", "robotworkloads")
POLICIES = Resource("understudy.dev", "v1alpha1", "failurepolicies")
POOLS = Resource("understudy.dev", "v1alpha1", "fallbackpools")

MERGE = "application/merge-patch+json"
JSON = "application/json-patch+json"
STRATEGIC = "application/strategic-merge-patch+json"
APPLY = "application/apply-patch+yaml"
TABLE = "application/json;as=Table;v=v1;g=meta.k8s.io,application/json"

_UNPRINTABLE = re.compile("[\x7f-\x9f\u2028\u2029\ufeff\ufffe\uffff]")
_NO_CHARACTER = re.compile("[\ud800-\udfff]")


def encoded(body: Any) -> bytes:
    """Return JSON that is YAML too, because the API server reads a server-side apply as YAML.

    That knows no pairs of escapes for one character, such as an emoji, and takes no unprintable character that is not escaped.
    """
    text = _NO_CHARACTER.sub("\ufffd", json.dumps(body, ensure_ascii=False))
    return _UNPRINTABLE.sub(lambda found: f"\\u{ord(found[0]):04x}", text).encode()


@dataclass(frozen=True)
class Part:
    """A part of a list.

    Its objects are parsed one after the other, since all of them at once take ten times the size of the text.
    """

    head: Object
    """The list without its objects."""
    body: bytes
    """The objects, as the API server wrote them."""

    @classmethod
    def of(cls, text: bytes) -> Part:
        """Return the part for an answer of the API server."""
        begin, end = text.find(_ITEMS) + len(_ITEMS), text.rfind(b"]")
        if begin < len(_ITEMS):  # the server does not write lists as expected
            head = decode(text)
            return cls(head, json.dumps(head.pop("items", None) or [])[1:-1].encode())
        return cls(decode(text[:begin] + text[end:]), text[begin:end])

    def items(self) -> Iterator[Object]:
        """Yield the objects. A list leaves out their kind."""
        kind = {"apiVersion": self.head["apiVersion"], "kind": self.head["kind"].removesuffix("List")}
        for item in decode_each(self.body.decode()):
            yield {**kind, **item}


_ITEMS = b'"items":['
"""The text before the objects. The list's metadata contains no list, neither before the objects nor after them."""


class RenewedToken(Protocol):
    """A token that is renewed, for example by a credential plugin (kubeconfig.py)."""

    async def token(self) -> str | None:
        """Return the present token; None if client certificates identify the client."""
        ...

    def reject(self) -> None:
        """Renew the token for the next request: the API server answered 401."""
        ...


@dataclass
class Access:
    """The address of the API server and the client's credentials. kubeconfig.py reads a kubeconfig."""

    server: str
    context: ssl.SSLContext
    token: str | None = None
    token_file: Path | None = None
    plugin: RenewedToken | None = None

    @classmethod
    def in_cluster(cls) -> Access:
        """Return the access of the pod's ServiceAccount."""
        host, port = os.environ["KUBERNETES_SERVICE_HOST"], os.environ["KUBERNETES_SERVICE_PORT"]
        if ":" in host:
            host = f"[{host}]"
        context = ssl.create_default_context(cafile=str(SERVICE_ACCOUNT / "ca.crt"))
        return cls(server=f"https://{host}:{port}", context=context, token_file=SERVICE_ACCOUNT / "token")

    async def bearer(self) -> str | None:
        """Return the token for the next request; None if client certificates identify the client."""
        if self.plugin is not None:
            return await self.plugin.token()
        return self.token_file.read_text() if self.token_file is not None else self.token


class Listener(Protocol):
    """Receives a report of each request and of each event of a watch."""

    def request_ended(self, method: str, path: str, status: int | None) -> None:
        """Called when a request has ended; ``status`` is None if there was no answer."""
        ...

    def event_received(self, resource: str) -> None:
        """Called when a watch of this resource has received something."""
        ...


class Client:
    """Sends requests to one API server. Use it as an asynchronous context manager."""

    def __init__(
        self, access: Access, *, timeout: float = 10.0, connections: int = 32, listener: Listener | None = None
    ) -> None:
        """``connections`` is the largest number of simultaneous connections; 0 for no limit."""
        self._access, self._connections, self._listener = access, connections, listener
        self._timeout = aiohttp.ClientTimeout(total=timeout)
        self._session: aiohttp.ClientSession | None = None
        self._token = access.token
        self._token_read = -math.inf
        self.contact = ApiContact()
        """Whether the API server answers."""

    async def __aenter__(self) -> Self:
        connector = aiohttp.TCPConnector(
            ssl=self._access.context,
            keepalive_timeout=3600,
            limit=self._connections,
            socket_factory=_probed_socket,
        )
        self._session = aiohttp.ClientSession(connector=connector)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._session is not None:
            await self._session.close()

    async def _headers(self) -> dict[str, str]:
        now = asyncio.get_running_loop().time()
        if self._access.plugin is not None:
            self._token = await self._access.plugin.token()
        elif self._access.token_file is not None and now - self._token_read >= _TOKEN_LIFETIME:
            self._token, self._token_read = await self._access.bearer(), now
        return {"Authorization": f"Bearer {self._token}"} if self._token else {}

    def _renew_token(self) -> None:
        """Have the next request read the token again: the API server does not accept it."""
        self._token_read = -math.inf
        if self._access.plugin is not None:
            self._access.plugin.reject()

    async def request(
        self,
        method: str,
        path: str,
        *,
        params: Mapping[str, str] | None = None,
        body: Any = None,
        content_type: str = "application/json",
    ) -> Object:
        """Send one request and return the object in the answer.

        Raises ApiError, aiohttp.ClientError or TimeoutError.
        """
        headers, data = {}, None
        if body is not None:
            headers["Content-Type"] = content_type
            data = encoded(body)
        result: Object = await decoded(await self._ask(method, path, params, headers, data))
        return result

    async def read(
        self, path: str, *, params: Mapping[str, str] | None = None, accept: str = "application/json"
    ) -> bytes:
        """Return the text of an answer to GET, uncompressed.

        Within a cluster, compressing a long answer costs more than sending it. Raises what :meth:`request` raises.
        """
        return await self._ask("GET", path, params, {"Accept": accept, "Accept-Encoding": "identity"})

    async def _ask(
        self,
        method: str,
        path: str,
        params: Mapping[str, str] | None,
        headers: Mapping[str, str],
        data: bytes | None = None,
    ) -> bytes:
        assert self._session is not None, "use the client as an asynchronous context manager"
        if self._session.closed:  # a task may outlive the client for a moment while the process ends
            raise aiohttp.ClientConnectionError("the client is closed")
        status, is_aggregated = None, path.startswith(_AGGREGATED)
        try:
            with contextlib.nullcontext() if is_aggregated else self.contact.asking():
                async with self._session.request(
                    method,
                    self._access.server + path,
                    params=params,
                    data=data,
                    headers={**await self._headers(), **headers},
                    timeout=self._timeout,
                ) as response:
                    text = await response.read()
                    status = response.status
                if status == 401 and not is_aggregated:
                    # No usable answer: raised within the context, so that the time does not count as answered.
                    self._renew_token()
                    raise _error(status, text.decode(errors="replace"))
        finally:
            if self._listener is not None:
                self._listener.request_ended(method, path, status)
        if status >= 400:
            raise _error(status, text.decode(errors="replace"), self.contact.just_back)
        return text

    async def get(self, resource: Resource, namespace: str | None, name: str) -> Object:
        """Return an object. Raises ApiError (404 if it does not exist)."""
        return await self.request("GET", resource.path(namespace, name))

    async def find(self, resource: Resource, namespace: str | None, name: str) -> Object | None:
        """Return an object, or None if it does not exist."""
        try:
            return await self.get(resource, namespace, name)
        except ApiError as error:
            if error.not_found:
                return None
            raise

    async def list(
        self,
        resource: Resource,
        namespace: str | None = None,
        *,
        labels: str | None = None,
        fields: str | None = None,
        cached: bool = False,
    ) -> Object:
        """Return a collection: ``items``, and ``metadata.resourceVersion`` to watch from.

        With ``cached``, the API server answers from its memory without asking the store. That answer is no older than
        what a watch receives.
        """
        params = _selectors(labels, fields) | ({"resourceVersion": "0"} if cached else {})
        return await self.request("GET", resource.path(namespace), params=params)

    async def table(self, resource: Resource, namespace: str, *, labels: str, fields: str) -> Object:
        """Return a collection from the API server's memory as a table (meta.k8s.io/v1 Table).

        The table has only what kubectl shows of each object. A server without tables answers with a list.
        """
        params = _selectors(labels, fields) | {"resourceVersion": "0", "includeObject": "None"}
        answer: Object = await decoded(await self.read(resource.path(namespace), params=params, accept=TABLE))
        return answer

    async def parts(
        self, resource: Resource, namespace: str | None = None, *, labels: str | None = None, limit: int = PAGE
    ) -> AsyncIterator[Part]:
        """Yield a collection as it is at one moment, in parts of ``limit`` objects.

        A fleet's collection as a whole would take ten times its size in memory. Raises ApiError, with status 410 if the
        server no longer remembers that moment.
        """
        params = _selectors(labels, None) | {"limit": str(limit)}
        while True:
            part = Part.of(await self.read(resource.path(namespace), params=params))
            yield part
            if not (more := part.head["metadata"].get("continue")):
                return
            params["continue"] = more

    async def create(self, resource: Resource, namespace: str | None, body: Object, *, dry_run: bool = False) -> Object:
        """Create an object. With ``dry_run``, the API server only validates it."""
        params = {"dryRun": "All"} if dry_run else None
        return await self.request("POST", resource.path(namespace), params=params, body=body)

    async def patch(
        self,
        resource: Resource,
        namespace: str | None,
        name: str,
        body: Any,
        *,
        kind: str = MERGE,
        subresource: str | None = None,
    ) -> Object:
        """Patch an object.

        A ``metadata.resourceVersion`` in a merge patch makes it fail with 409 if another writer came first.
        """
        return await self.request("PATCH", resource.path(namespace, name, subresource), body=body, content_type=kind)

    async def apply(
        self, resource: Resource, namespace: str | None, body: Object, *, manager: str, subresource: str | None = None
    ) -> Object:
        """Write by server-side apply (KEP-555) as the named field manager. It takes over fields of other managers."""
        path = resource.path(namespace, body["metadata"]["name"], subresource)
        params = {"fieldManager": manager, "force": "true"}
        return await self.request("PATCH", path, params=params, body=body, content_type=APPLY)

    async def delete(
        self,
        resource: Resource,
        namespace: str | None,
        name: str,
        *,
        uid: str | None = None,
        grace_seconds: int | None = None,
    ) -> Object | None:
        """Delete an object; with ``uid``, only the object with that UID.

        Returns the answer: of a pod, the pod that is being deleted. An object that does not exist is no error: then returns None.
        """
        options: Object = {"kind": "DeleteOptions", "apiVersion": "v1", "propagationPolicy": "Background"}
        if uid is not None:
            options["preconditions"] = {"uid": uid}
        if grace_seconds is not None:
            options["gracePeriodSeconds"] = grace_seconds
        try:
            return await self.request("DELETE", resource.path(namespace, name), body=options)
        except ApiError as error:
            if not error.not_found and not (error.conflict and uid is not None):
                raise
            return None

    async def watch(
        self,
        resource: Resource,
        namespace: str | None = None,
        *,
        version: str,
        labels: str | None = None,
        fields: str | None = None,
        lifetime: int | None = None,
    ) -> AsyncIterator[tuple[str, Object]]:
        """Yield events ``(type, object)`` after a resourceVersion, bookmarks included, until the server ends the watch.

        Raises Expired if the version is too old. ``lifetime`` is in seconds. The default differs for each watch, so
        that the watches of a fleet that started together do not all start again together. A connection without data for
        SILENCE seconds is closed.
        """
        if lifetime is None:
            lifetime = random.randint(*LIFETIME)
        assert self._session is not None, "use the client as an asynchronous context manager"
        params = _selectors(labels, fields) | {
            "watch": "true",
            "resourceVersion": version,
            "allowWatchBookmarks": "true",
            "timeoutSeconds": str(lifetime),
        }
        timeout = aiohttp.ClientTimeout(total=None, sock_connect=10, sock_read=SILENCE)
        async with self._session.get(
            self._access.server + resource.path(namespace),
            params=params,
            headers=await self._headers(),
            timeout=timeout,
        ) as response:
            if self._listener is not None:
                self._listener.request_ended("WATCH", resource.path(namespace), response.status)
            if response.status == 401:
                self._renew_token()
            if response.status >= 400:
                raise Expired if response.status == 410 else _error(response.status, await response.text())
            buffer = b""
            async for chunk in response.content.iter_any():
                if self._listener is not None:
                    self._listener.event_received(resource.plural)
                *lines, buffer = (buffer + chunk).split(b"\n")
                for line in lines:
                    event = await decoded(line)
                    if event["type"] == "ERROR":
                        code = event["object"].get("code", 500)
                        raise Expired if code == 410 else _error(code, json.dumps(event["object"]))
                    yield event["type"], event["object"]


def _probed_socket(address: tuple[Any, ...]) -> socket.socket:
    """Create a socket for an address (an entry of getaddrinfo) whose other side the kernel probes while nothing is sent."""
    family, kind, protocol, *_ = address
    made = socket.socket(family, kind, protocol)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _KEEPALIVE.items():
        if (option := getattr(socket, name, None)) is not None:  # some are not there on every system of a command line
            made.setsockopt(socket.IPPROTO_TCP, option, value)
    return made


def _selectors(labels: str | None, fields: str | None) -> dict[str, str]:
    return ({"labelSelector": labels} if labels else {}) | ({"fieldSelector": fields} if fields else {})


def _error(status: int, text: str, just_back: bool = False) -> ApiError:
    try:
        answer = decode(text)
        reason, message = answer.get("reason") or "Error", answer.get("message") or text
    except (ValueError, AttributeError):
        reason, message = "Error", text[:500]
    if status == 401:
        message = f"{message} ({_UNKNOWN_CLIENT})"
    return ApiError(status, reason, message, just_back=just_back)

"""Metrics of the requests to the API server, and of when each watch last received something."""

from __future__ import annotations

from prometheus_client import CollectorRegistry, Counter, Gauge


def series(registry: CollectorRegistry) -> tuple[Counter, Gauge]:
    """Create the metrics of one process."""
    requests = Counter(
        "understudy_api_requests",
        "Requests to the API server, by result: the HTTP status, or error if there was no answer.",
        ["method", "resource", "code"],
        registry=registry,
    )
    last_event = Gauge(
        "understudy_watch_last_event_timestamp_seconds",
        "When watches of a resource last received an event (Unix time in seconds). The API server sends a bookmark about once a minute.",
        ["resource"],
        registry=registry,
    )
    return requests, last_event


class Traffic:
    """Implements :class:`understudy.kube.client.Listener`."""

    def __init__(self, requests: Counter, last_event: Gauge) -> None:
        self._requests, self._last_event = requests, last_event

    def request_ended(self, method: str, path: str, status: int | None) -> None:
        """Count a request."""
        code = "error" if status is None else str(status)
        self._requests.labels(method=method, resource=plural(path), code=code).inc()

    def event_received(self, resource: str) -> None:
        """Note that a watch received something."""
        self._last_event.labels(resource=resource).set_to_current_time()


def plural(path: str) -> str:
    """Return the plural name of the resource of an API path; empty if the path names no resource."""
    parts = path.strip("/").split("/")
    parts = parts[3:] if parts[0] == "apis" else parts[2:]
    if parts[:1] == ["namespaces"] and len(parts) > 2:
        parts = parts[2:]
    return parts[0] if parts else ""

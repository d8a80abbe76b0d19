"""A client of one service on a served node.

rclpy's own ``call_async`` needs an executor to take the answer. Here the thread of the served node takes it.
"""

from __future__ import annotations

import asyncio
from typing import Any

from rclpy.qos import qos_profile_services_default

from understudy.ros.runtime.served_node import ServedNode


class ServiceClient:
    """Calls one service. Create and close it in the thread of the served node, and call it from the event loop."""

    def __init__(self, served: ServedNode, type_: Any, service: str) -> None:
        self._served, self._response = served, type_.Response
        self._client = served.node.create_client(type_, service, qos_profile=qos_profile_services_default)
        self._waiting: dict[int, asyncio.Future[Any]] = {}
        served.add("client", self._client, self._take)

    def ready(self) -> bool:
        """Return whether a server of the service is matched."""
        return bool(self._client.service_is_ready())

    async def call(self, request: Any) -> Any:
        """Return the answer to a request. Waits for as long as the server takes: callers set a bound."""
        future: asyncio.Future[Any] = asyncio.get_running_loop().create_future()

        def send() -> int:
            with self._client.handle:
                number: int = self._client.handle.send_request(request)
            self._waiting[number] = future
            return number

        number = await self._served.get(send)
        try:
            return await future
        finally:
            self._waiting.pop(number, None)

    def close(self) -> None:
        """End the client."""
        self._served.remove("client", self._client)

    def _take(self) -> None:
        while True:
            with self._client.handle:
                info, response = self._client.handle.take_response(self._response)
            if info is None:
                return
            future = self._waiting.get(info.request_id.sequence_number)
            if future is not None:
                self._served.call_in_loop(_settle, future, response)


def _settle(future: asyncio.Future[Any], response: Any) -> None:
    if not future.done():
        future.set_result(response)

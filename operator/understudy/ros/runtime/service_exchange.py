"""Takes requests of services and answers them at any later time, also from another process than the one that took them.

rclpy answers a request when the callback for it returns. The task proxy answers a goal when the instance has decided,
and a request for a result at the goal's end, perhaps after its own restart. So this module takes a request's identity
as plain bytes, and calls ``rcl_take_request_with_info`` and ``rcl_send_response`` directly. The middleware matches an
answer to its request by that identity alone, not by the process that sends it.
"""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import rclpy  # noqa: F401  (loads the libraries that are looked up below)

from understudy.ros.runtime.sample_taking import loaded

_READER = 0x04
"""The kind in the last byte of a GUID for a reader without a key; a writer's is 3."""

_OK = 0
_TIMEOUT = 2  # RCL_RET_TIMEOUT: the client is not matched (yet)
_TAKE_FAILED = 601  # RCL_RET_SERVICE_TAKE_FAILED: the queue is empty

_INFO = struct.Struct("@qq16sq")
"""rmw_service_info_t: source and received timestamp, then rmw_request_id_t: writer's GUID and sequence number."""

_ID = struct.Struct("@16sq")


class RequestId(NamedTuple):
    """The identity of a request: the client and the number of the request."""

    client: str
    """GUID of the client's reader, in hex."""
    sequence: int


def request_writer(request: RequestId, writers: Iterable[bytes]) -> bytes | None:
    """Return the writer, among those of a service's requests (their GUIDs), of the client that made a request.

    rmw_fastrtps identifies a client by its reader, and sends no answer to a client from which it has taken no request.
    A client also accepts answers that are addressed to its writer, so any process can answer that way. Reader and
    writer belong to one participant, and the writer is created right after the reader. So if the participant has
    several writers, the next one after the reader is the client's.
    """
    reader = bytes.fromhex(request.client)
    if not reader[15] & _READER:
        return reader
    own = [writer for writer in writers if writer[:12] == reader[:12]]
    later = [writer for writer in own if writer[12:15] > reader[12:15]]
    if later:
        return min(later)
    return own[0] if len(own) == 1 else None


class ServiceExchangeError(RuntimeError):
    """The middleware failed to take a request or to send an answer."""


@dataclass(frozen=True)
class _Converter:
    """The functions that convert a message from Python to C and back. Call them only with the GIL."""

    create: Callable[[], int]
    destroy: Callable[[int], None]
    from_python: Callable[[Any, int], bool]
    to_python: Callable[[int], Any]


@lru_cache(maxsize=256)
def _converter(message_class: Any) -> _Converter:
    meta = message_class.__class__
    if meta._TYPE_SUPPORT is None:
        meta.__import_type_support__()

    def function(name: str, result: Any, *arguments: Any) -> Any:
        return ctypes.PYFUNCTYPE(result, *arguments)(_pointer(getattr(meta, name)))

    return _Converter(
        create=function("_CREATE_ROS_MESSAGE", ctypes.c_void_p),
        destroy=function("_DESTROY_ROS_MESSAGE", None, ctypes.c_void_p),
        from_python=function("_CONVERT_FROM_PY", ctypes.c_bool, ctypes.py_object, ctypes.c_void_p),
        to_python=function("_CONVERT_TO_PY", ctypes.py_object, ctypes.c_void_p),
    )


def _pointer(capsule: object) -> int:
    api = ctypes.pythonapi
    api.PyCapsule_GetName.restype, api.PyCapsule_GetName.argtypes = ctypes.c_char_p, [ctypes.py_object]
    api.PyCapsule_GetPointer.restype = ctypes.c_void_p
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    found: int = api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule))
    return found


class ServiceExchange:
    """Takes requests and sends answers. For use in one thread; one exchange serves all services of a process."""

    def __init__(self) -> None:
        library, utils = loaded("librcl"), loaded("librcutils")
        self._reset_error = utils.rcutils_reset_error
        self._take = library.rcl_take_request_with_info
        self._take.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
        self._send = library.rcl_send_response
        self._send.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
        self._info = ctypes.create_string_buffer(_INFO.size)

    def take(self, service: Any, request_class: Any) -> tuple[Any, RequestId] | None:
        """Take the oldest request in a service's queue; None if there is none. Raises ServiceExchangeError."""
        converter = _converter(request_class)
        message = converter.create()
        try:
            with service.handle:
                result = self._take(service.handle.pointer, self._info, message)
            if result == _TAKE_FAILED:
                return None
            if result != _OK:
                self._reset_error()
                raise ServiceExchangeError(f"taking a request of {service.srv_name} failed with rcl's code {result}")
            _, _, client, sequence = _INFO.unpack(self._info.raw)
            return converter.to_python(message), RequestId(client.hex(), sequence)
        finally:
            converter.destroy(message)

    def answer(self, service: Any, response: Any, request: RequestId) -> bool:
        """Send the answer to a request. Returns False while the client is not matched.

        The caller then has to try again, and the call blocks for up to 100 ms. If the client has gone, the answer
        counts as sent. Raises ServiceExchangeError.
        """
        message_class: Any = type(response)
        converter = _converter(message_class)
        message = converter.create()
        try:
            if not converter.from_python(response, message):
                raise ServiceExchangeError(f"{service.srv_name}: the answer cannot be converted")
            identity = ctypes.create_string_buffer(_ID.pack(bytes.fromhex(request.client), request.sequence), _ID.size)
            with service.handle:
                result = self._send(service.handle.pointer, identity, message)
        finally:
            converter.destroy(message)
        if result not in (_OK, _TIMEOUT):
            self._reset_error()
            raise ServiceExchangeError(f"answering a request of {service.srv_name} failed with rcl's code {result}")
        if result == _TIMEOUT:
            self._reset_error()
        return bool(result == _OK)

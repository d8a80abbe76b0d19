"""Takes serialized samples from a subscription's queue, with their senders and times of receipt, and publishes them again.

rclpy returns a message's timestamps but drops its publisher's GID, which is the only way to distinguish two pods that
publish the same topic. So this module calls ``rcl_take_serialized_message`` directly, into one buffer that grows as
needed and is used again. That also costs less than a Python object per message.
"""

from __future__ import annotations

import ctypes
import re
import struct
import weakref
from typing import NamedTuple

import rclpy  # noqa: F401  (loads the libraries that are looked up below)

_OK = 0
_TAKE_FAILED = 401  # RCL_RET_SUBSCRIPTION_TAKE_FAILED: the queue is empty

_FIRST_CAPACITY = 4096


class Sample(NamedTuple):
    """One received message."""

    received: float
    """When the middleware received it, Unix seconds by this machine's clock."""
    sent: float
    """When it was written, Unix seconds by the sender's clock."""
    gid: bytes
    """GID of the writer, 16 bytes."""
    sequence: int
    """Number of the message in its writer's sequence, from 1."""
    data: bytes
    """CDR with its 4-byte header; empty if it was not asked for."""


class TakeError(RuntimeError):
    """The middleware failed to return a sample."""


class PublishError(RuntimeError):
    """The middleware failed to publish a sample."""


class _Allocator(ctypes.Structure):
    """rcutils_allocator_t."""

    _fields_ = [(name, ctypes.c_void_p) for name in ("allocate", "deallocate", "reallocate", "zero_allocate", "state")]


class _Bytes(ctypes.Structure):
    """rcutils_uint8_array_t."""

    _fields_ = [
        ("buffer", ctypes.c_void_p),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("allocator", _Allocator),
    ]


_INFO = struct.Struct("@qqQQP16s?")
"""rmw_message_info_t: source and received timestamp (ns), publication and reception sequence number, the GID of the
publisher (rmw_gid_t: pointer to the implementation's name, 16 bytes), whether it was sent from within the process."""


def loaded(name: str) -> ctypes.CDLL:
    """Return a library that rclpy has loaded. It is found by its path, since wheels keep it off the loader's search
    path."""
    pattern = re.compile(rf"/{name}(-[0-9a-f]+)?\.so[.0-9]*$")
    with open("/proc/self/maps") as maps:
        for line in maps:
            path = line.rstrip().split(maxsplit=5)[-1]
            if pattern.search(path):
                return ctypes.CDLL(path)
    raise ImportError(f"rclpy has not loaded {name}.so: Understudy needs ROS 2 Jazzy")


class SampleTaker:
    """Takes samples into one reused buffer. For use in one thread; one taker serves all subscriptions of a process."""

    def __init__(self) -> None:
        utils = loaded("librcutils")
        utils.rcutils_get_default_allocator.restype = _Allocator
        utils.rcutils_uint8_array_init.argtypes = [
            ctypes.POINTER(_Bytes),
            ctypes.c_size_t,
            ctypes.POINTER(_Allocator),
        ]
        utils.rcutils_uint8_array_fini.argtypes = [ctypes.POINTER(_Bytes)]
        self._reset_error = utils.rcutils_reset_error
        self._allocator = utils.rcutils_get_default_allocator()
        self._bytes = _Bytes()
        if utils.rcutils_uint8_array_init(self._bytes, _FIRST_CAPACITY, self._allocator) != _OK:
            raise MemoryError(f"no {_FIRST_CAPACITY} bytes for samples")
        # The compiler rounds the size of the struct up like this. One unpack reads it, for a tenth of the cost of
        # accessing the fields by ctypes.
        self._info = ctypes.create_string_buffer((_INFO.size + 7) // 8 * 8)
        self._take = loaded("librcl").rcl_take_serialized_message
        self._take.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
        self._publish = loaded("librcl").rcl_publish_serialized_message
        self._publish.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
        self._into = (ctypes.addressof(self._bytes), ctypes.addressof(self._info), None)
        weakref.finalize(self, utils.rcutils_uint8_array_fini, self._bytes)

    def take(self, pointer: int, *, with_data: bool = True) -> Sample | None:
        """Take the oldest sample in the queue; None if there is none.

        ``pointer`` is that of an rclpy subscription's handle. The caller has entered the handle (``with
        subscription.handle``), so that it cannot be destroyed meanwhile. Raises TakeError.
        """
        result = self._take(pointer, *self._into)
        if result == _TAKE_FAILED:
            return None
        if result != _OK:
            self._reset_error()
            raise TakeError(f"taking a sample failed with rcl's code {result}")
        sent, received, sequence, _, _, gid, _ = _INFO.unpack_from(self._info)
        return Sample(received * 1e-9, sent * 1e-9, gid, sequence, self.data() if with_data else b"")

    def publish(self, pointer: int) -> None:
        """Publish the sample that was taken last, as its bytes are.

        ``pointer`` is that of the handle of an rclpy publisher of the same type, entered as for :meth:`take`. Raises PublishError.
        """
        result = self._publish(pointer, self._into[0], None)
        if result != _OK:
            self._reset_error()
            raise PublishError(f"publishing a sample failed with rcl's code {result}")

    def data(self, most: int | None = None) -> bytes:
        """Return up to ``most`` bytes of the sample that was taken last, for callers that decide by its sender."""
        length = self._bytes.length
        return ctypes.string_at(self._bytes.buffer, length if most is None else min(most, length))

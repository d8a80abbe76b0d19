"""Takes serialized samples out of a subscription's queue, with who sent them and when they were received.

rclpy hands out a message's timestamps and drops its publisher's GID, which alone tells two pods apart that publish the
same topic. So ``rcl_take_serialized_message`` is called directly, into one buffer that grows as needed and is used
again, which also costs less than a Python object per message.
"""

from __future__ import annotations

import ctypes
import re
import weakref
from typing import Any, NamedTuple

import rclpy  # noqa: F401  (loads the libraries that are looked up below)

_OK = 0
_TAKE_FAILED = 401  # RCL_RET_SUBSCRIPTION_TAKE_FAILED: the queue is empty

_GID_SIZE = 16
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
    """CDR with its 4-byte header; empty where it wasn't asked for."""


class TakeError(RuntimeError):
    """The middleware failed to give out a sample."""


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


class _Gid(ctypes.Structure):
    """rmw_gid_t."""

    _fields_ = [("implementation", ctypes.c_char_p), ("data", ctypes.c_uint8 * _GID_SIZE)]


class _Info(ctypes.Structure):
    """rmw_message_info_t."""

    _fields_ = [
        ("source_timestamp", ctypes.c_int64),
        ("received_timestamp", ctypes.c_int64),
        ("publication_sequence_number", ctypes.c_uint64),
        ("reception_sequence_number", ctypes.c_uint64),
        ("publisher_gid", _Gid),
        ("from_intra_process", ctypes.c_bool),
    ]


def _loaded(name: str) -> ctypes.CDLL:
    """The library that rclpy has loaded; by its path, since wheels keep it off the loader's search path."""
    pattern = re.compile(rf"/{name}(-[0-9a-f]+)?\.so[.0-9]*$")
    with open("/proc/self/maps") as maps:
        for line in maps:
            path = line.rstrip().split(maxsplit=5)[-1]
            if pattern.search(path):
                return ctypes.CDLL(path)
    raise ImportError(f"rclpy has not loaded {name}.so: is it ROS 2 Jazzy?")


class Taker:
    """Takes samples into one reused buffer. For one thread; one serves all subscriptions of a process."""

    def __init__(self) -> None:
        utils = _loaded("librcutils")
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
        self._info = _Info()
        self._take = _loaded("librcl").rcl_take_serialized_message
        self._take.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
        self._arguments = (ctypes.byref(self._bytes), ctypes.byref(self._info), None)
        weakref.finalize(self, utils.rcutils_uint8_array_fini, self._bytes)

    def take(self, handle: Any, *, with_data: bool = True) -> Sample | None:
        """The oldest sample in the queue, None when there is none.

        ``handle`` is an rclpy subscription's ``handle``, entered (``with subscription.handle``) by the caller, so that
        it can't be destroyed meanwhile. Raises TakeError.
        """
        result = self._take(handle.pointer, *self._arguments)
        if result == _TAKE_FAILED:
            return None
        if result != _OK:
            self._reset_error()
            raise TakeError(f"taking a sample failed with rcl's code {result}")
        info = self._info
        return Sample(
            info.received_timestamp * 1e-9,
            info.source_timestamp * 1e-9,
            bytes(info.publisher_gid.data),
            info.publication_sequence_number,
            ctypes.string_at(self._bytes.buffer, self._bytes.length) if with_data else b"",
        )

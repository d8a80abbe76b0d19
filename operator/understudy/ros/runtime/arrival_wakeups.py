"""Wakes an event loop when messages arrive on drained subscriptions, services and clients.

The middleware calls a C function for each message, in a thread of its own. Here that function is the C library's
``eventfd_write``, whose two arguments are exactly those that the middleware passes: a word of ours, and the number of
messages. So no Python runs in that thread, and an event loop waits for the descriptor as for any other (eventfd(2)).
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
from typing import Any

from understudy.ros.runtime.sample_taking import loaded

_logger = logging.getLogger(__name__)


class ArrivalWakeups:
    """A file descriptor that becomes readable when a message has arrived since it was last cleared."""

    def __init__(self) -> None:
        self.descriptor = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.asked = False
        """Whether any subscription was added."""
        self._write = ctypes.cast(ctypes.CDLL(None).eventfd_write, ctypes.c_void_p)
        library = loaded("librcl")
        self._set = library.rcl_subscription_set_on_new_message_callback
        self._set_for_service = library.rcl_service_set_on_new_request_callback
        self._set_for_client = library.rcl_client_set_on_new_response_callback
        for function in (self._set, self._set_for_service, self._set_for_client):
            function.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
        self._reset_error = loaded("librcutils").rcutils_reset_error

    def add(self, handle: Any) -> None:
        """Report messages that arrive on the subscription with this rclpy handle, and those that already wait there."""
        self._add(self._set, handle)

    def add_service(self, handle: Any) -> None:
        """Report requests that arrive at the service with this rclpy handle."""
        self._add(self._set_for_service, handle)

    def add_client(self, handle: Any) -> None:
        """Report answers that arrive at the client with this rclpy handle."""
        self._add(self._set_for_client, handle)

    def _add(self, function: Any, handle: Any) -> None:
        with handle:
            result = function(handle.pointer, self._write, self.descriptor)
        if result != 0:
            self._reset_error()
            _logger.warning(
                "the middleware does not report new messages (rcl error %d), so they are noticed only when they are polled",
                result,
            )
            return
        self.asked = True

    def forget(self, handle: Any) -> None:
        """Stop reporting a subscription, for example before it is removed."""
        with handle:
            if self._set(handle.pointer, None, None) != 0:
                self._reset_error()

    def clear(self) -> None:
        """Clear the descriptor until the next message arrives."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.descriptor)

    def close(self) -> None:
        """Close the descriptor. All subscriptions must have been removed."""
        os.close(self.descriptor)

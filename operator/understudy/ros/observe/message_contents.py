"""Received messages whose contents are examined: stored as bytes, and deserialized at the first use."""

from __future__ import annotations

import struct
from typing import Any

from understudy.trees.core.observations import Unreadable
from understudy.trees.leaves.diagnostics import OWN

HEAD = 12
"""Bytes of a serialized message up to the end of its header's stamp: CDR's own header, seconds, nanoseconds."""

_NAME = slice(32, 32 + len(OWN))
"""Position of the name of a DiagnosticArray's first status in its serialized form.

Before it are CDR's own header, the stamp, an empty frame, the number of statuses, the level and the length of the name,
each at a multiple of 4 bytes behind that header.
"""

OURS = _NAME.stop
"""Number of bytes that show whether Understudy published the message."""

_OWN = OWN.encode()

_LITTLE, _BIG = struct.Struct("<iI"), struct.Struct(">iI")


def ours(data: bytes) -> bool:
    """Whether a serialized DiagnosticArray was published by an Understudy, and so is no evidence.

    Its first OURS bytes are enough.
    """
    return data[_NAME] == _OWN


def begins_with_header(message: Any) -> bool:
    """Whether messages of a class begin with a std_msgs/Header, which is the convention for messages that have one."""
    return next(iter(message.get_fields_and_field_types().values()), None) == "std_msgs/Header"


class Received:
    """Implements :class:`understudy.trees.core.observations.Content`.

    Several leaves may use one; it is deserialized once.
    """

    __slots__ = ("_class", "_data", "_failure", "_message", "_sent", "_stamped", "_taken", "received")

    def __init__(
        self, received: float, taken: float, data: bytes, message: Any, stamped: bool, sent: float = 0.0
    ) -> None:
        """``received`` is the time of receipt, and ``taken`` the same by the clock at that time.

        ``data`` is CDR with its header, of a message of the class ``message``. It is ``stamped`` if it begins with a
        header. ``sent`` is when its writer wrote it, by the clock there; 0 if that is not known. Times are Unix
        seconds.
        """
        self.received = received
        self._taken, self._data, self._class, self._stamped = taken, data, message, stamped
        self._sent = sent
        self._message: Any = None
        self._failure = ""

    def message(self) -> object:
        """Return the message. Raises Unreadable."""
        if self._message is None and not self._failure:
            from rclpy.serialization import deserialize_message

            try:
                self._message = deserialize_message(self._data, self._class)
            except Exception as error:  # the middleware does not document what it raises for bytes of another type
                self._failure = f"it is no {self._class.__name__}: {error}"
        if self._failure:
            raise Unreadable(self._failure)
        return self._message

    def age(self) -> float | None:
        """Return the age of its stamp at its receipt, in seconds.

        A stamp of 0 counts as none, because nobody set it.
        """
        if not self._stamped or len(self._data) < HEAD:
            return None
        seconds, nanoseconds = (_LITTLE if self._data[1] & 1 else _BIG).unpack_from(self._data, 4)
        return self._taken - seconds - nanoseconds * 1e-9 if seconds or nanoseconds else None

    def under_way(self) -> float | None:
        """Return the seconds from its writing, by the writer's clock, to its receipt."""
        return self._taken - self._sent if self._sent > 0 else None

    def older(self, stamp: float) -> float:
        """Return the seconds from a stamp to the receipt of the message, both by the clocks at that time."""
        return self._taken - stamp

    def mentions(self, text: str) -> bool:
        """Whether its bytes contain this text."""
        return text.encode() in self._data

    def byte(self, place: int) -> int | None:
        """Return one of its bytes; None if it is shorter."""
        return self._data[place] if place < len(self._data) else None

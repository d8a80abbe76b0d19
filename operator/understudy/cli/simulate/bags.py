"""Reads recorded bags without ROS: rosbag2 folders, and single MCAP or SQLite files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, NamedTuple, Self

from understudy.cli.common.errors import CommandError
from understudy.ros.observe.message_contents import Received
from understudy.trees.core.observations import Unreadable
from understudy.trees.leaves.age import HEADER

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Reader

    from understudy.cli.simulate.bag_types import Definitions

_NS = 1e-9
_REMEDIES = {
    "end magic": "repair an incomplete recording with `mcap recover`",
    "footer": "repair an incomplete recording with `mcap recover`",
    "files are missing": "the folder's metadata.yaml names files that are missing: copy them too, or give one of its files instead",
    "Cannot open database": "rosbag2 did not write it, or it is incomplete; give a rosbag2 folder, or another file of one",
    "Unrecognized storage": "its name must end in .mcap or .db3",
    "metadata file": "give a folder that has a metadata.yaml, or one .mcap or .db3 file; `ros2 bag reindex` writes a new metadata.yaml",
}
_FORMS = "give a rosbag2 folder, or an .mcap or .db3 file of one"


@dataclass(frozen=True)
class BagTopic:
    """A recorded topic."""

    name: str
    types: tuple[str, ...]
    """More than one only if its publishers disagreed."""
    count: int
    """Messages."""


class BagTrack(NamedTuple):
    """One recorded message."""

    topic: str
    received: float
    """The time of receipt by the recorder, in unix seconds."""
    data: bytes
    """CDR with its header."""


class Recorded(Received):
    """A recorded message with access to its contents."""

    __slots__ = ("_definitions", "_type")

    def __init__(self, taken: BagTrack, type_name: str, definitions: Definitions) -> None:
        stamped = next(iter((definitions.fields(type_name) or {}).values()), None) == HEADER
        super().__init__(taken.received, taken.received, taken.data, None, stamped)
        self._definitions, self._type = definitions, type_name

    def message(self) -> object:
        """Return the message. Raises Unreadable."""
        if self._message is None and not self._failure:
            try:
                self._message = self._definitions.read(self._data, self._type)
            except Exception as error:  # the errors for bytes of another type are not documented
                self._failure = f"not a valid {self._type}: {error}"
        if self._failure:
            raise Unreadable(self._failure)
        return self._message


class Bag:
    """An open bag. Times are unix seconds of the recorder's clock."""

    def __init__(self, path: str, reader: Reader, definitions: Definitions) -> None:
        self.path = path
        self._reader, self.definitions = reader, definitions
        self.start = reader.start_time * _NS
        """The time of receipt of the first message."""
        self.end = (reader.end_time - 1) * _NS
        """The time of receipt of the last message."""
        self.topics: Mapping[str, BagTopic] = {
            name: BagTopic(name, tuple(sorted({one.msgtype for one in info.connections})), info.msgcount)
            for name, info in reader.topics.items()
        }

    @classmethod
    def open(cls, path: str) -> Self:
        """Open a bag. Raises CommandError."""
        try:
            from rosbags.rosbag2 import Reader

            from understudy.cli.simulate.bag_types import Definitions
        except ImportError as error:
            raise CommandError(
                f"bags need the Python package rosbags, which is not installed ({error}): install understudy with the "
                "extra bags: pip install '.[bags]' in its repository"
            ) from error
        if not Path(path).exists():
            raise CommandError(f"{path}: no such file or folder; {_FORMS}")
        try:
            reader = Reader(path)
            reader.open()
        except Exception as error:  # the errors for a file that is not a bag are not documented
            reason = str(error) or type(error).__name__
            remedy = next((text for found, text in _REMEDIES.items() if found in reason), _FORMS)
            raise CommandError(f"{path}: this cannot be read as a bag: {reason.rstrip('.')}; {remedy}") from error
        if not reader.message_count:
            reader.close()
            raise CommandError(f"{path}: the bag contains no message; give another bag")
        return cls(path, reader, Definitions(reader.connections))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._reader.close()

    def messages(self, wanted: Mapping[str, str]) -> Iterator[BagTrack]:
        """Yield the messages of topics with these types (by name), oldest first. Raises CommandError if the bag is damaged."""
        connections: list[Connection] = [
            one for one in self._reader.connections if wanted.get(one.topic) == one.msgtype
        ]
        if not connections:
            return
        latest = 0.0
        try:
            for connection, stamp, data in self._reader.messages(connections=connections):
                # The files of a split recording overlap a little.
                latest = max(latest, stamp * _NS)
                yield BagTrack(connection.topic, latest, data)
        except Exception as error:
            reason = str(error) or type(error).__name__
            raise CommandError(
                f"{self.path}: the bag is damaged: {reason}; record it again, or repair an MCAP file with `mcap recover`"
            ) from error

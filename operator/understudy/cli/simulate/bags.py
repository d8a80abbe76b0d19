"""Recorded bags: rosbag2 folders, and single MCAP and SQLite files of them, read without ROS."""

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
_WAYS_OUT = {
    "end magic": "a recording that was cut off is repaired by `mcap recover`",
    "footer": "a recording that was cut off is repaired by `mcap recover`",
    "files are missing": "the folder's metadata.yaml names files that aren't in it: copy them too, or give one of its files instead",
    "Cannot open database": "it isn't one that rosbag2 has written, or it was cut off; give a rosbag2 folder, or another file of one",
    "Unrecognized storage": "its name must end in .mcap or .db3",
    "metadata file": "give a folder that has a metadata.yaml, or one .mcap or .db3 file; `ros2 bag reindex` writes a metadata.yaml anew",
}
_FORMS = "give a rosbag2 folder, or an .mcap or .db3 file of one"


@dataclass(frozen=True)
class BagTopic:
    """A topic that was recorded."""

    name: str
    types: tuple[str, ...]
    """More than one only where its publishers disagreed."""
    count: int
    """Messages."""


class Taken(NamedTuple):
    """One recorded message."""

    topic: str
    received: float
    """When the recorder received it, in Unix seconds."""
    data: bytes
    """CDR with its header."""


class Recorded(Received):
    """A recorded message that is looked into."""

    __slots__ = ("_definitions", "_type")

    def __init__(self, taken: Taken, type_name: str, definitions: Definitions) -> None:
        stamped = next(iter((definitions.fields(type_name) or {}).values()), None) == HEADER
        super().__init__(taken.received, taken.received, taken.data, None, stamped)
        self._definitions, self._type = definitions, type_name

    def message(self) -> object:
        """The message. Raises Unreadable."""
        if self._message is None and not self._failure:
            try:
                self._message = self._definitions.read(self._data, self._type)
            except Exception as error:  # what is raised for bytes of another type isn't said
                self._failure = f"it is no {self._type}: {error}"
        if self._failure:
            raise Unreadable(self._failure)
        return self._message


class Bag:
    """A bag that is open. Times are Unix seconds, as the recorder's clock had them."""

    def __init__(self, path: str, reader: Reader, definitions: Definitions) -> None:
        self.path = path
        self._reader, self.definitions = reader, definitions
        self.start = reader.start_time * _NS
        """When the first message was received."""
        self.end = (reader.end_time - 1) * _NS
        """When the last one was."""
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
                f"bags are read with the Python package rosbags, which isn't here ({error}): install understudy with its "
                "extra bags: pip install '.[bags]' in its repository"
            ) from error
        if not Path(path).exists():
            raise CommandError(f"{path}: there is no such file or folder; {_FORMS}")
        try:
            reader = Reader(path)
            reader.open()
        except Exception as error:  # whatever a file that is no bag makes of a reader
            told = str(error) or type(error).__name__
            way_out = next((way for found, way in _WAYS_OUT.items() if found in told), _FORMS)
            raise CommandError(f"{path}: this can't be read as a bag: {told.rstrip('.')}; {way_out}") from error
        if not reader.message_count:
            reader.close()
            raise CommandError(f"{path}: there is no message in it; give a bag in which something was recorded")
        return cls(path, reader, Definitions(reader.connections))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._reader.close()

    def messages(self, wanted: Mapping[str, str]) -> Iterator[Taken]:
        """The messages of topics of these types (by name), oldest first. Raises CommandError where the bag is damaged."""
        connections: list[Connection] = [
            one for one in self._reader.connections if wanted.get(one.topic) == one.msgtype
        ]
        if not connections:
            return
        latest = 0.0
        try:
            for connection, stamp, data in self._reader.messages(connections=connections):
                # The files of a split recording follow each other with a little overlap.
                latest = max(latest, stamp * _NS)
                yield Taken(connection.topic, latest, data)
        except Exception as error:
            told = str(error) or type(error).__name__
            raise CommandError(
                f"{self.path}: the bag is damaged: {told}; record it again, or repair an MCAP file by `mcap recover`"
            ) from error

"""The configuration of the tracker, from its YAML file. Errors name the field, what was found and what would be right."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from understudy.api.base import seconds
from understudy.api.ros_names import ROS_NAME_PATTERN
from understudy.trees.source.problems import did_you_mean

Dictionary = Literal[
    "DICT_4X4_50",
    "DICT_4X4_100",
    "DICT_4X4_250",
    "DICT_4X4_1000",
    "DICT_5X5_50",
    "DICT_5X5_100",
    "DICT_5X5_250",
    "DICT_5X5_1000",
    "DICT_6X6_50",
    "DICT_6X6_100",
    "DICT_6X6_250",
    "DICT_6X6_1000",
    "DICT_7X7_50",
    "DICT_7X7_100",
    "DICT_7X7_250",
    "DICT_7X7_1000",
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_16h5",
    "DICT_APRILTAG_25h9",
    "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_36h11",
]
"""OpenCV's names of marker dictionaries."""

LONGEST = 10.0
"""Maximum length of a velocity's window, in seconds."""


class ConfigurationError(ValueError):
    """A configuration that cannot be used. The text has a line for each problem."""


def _duration(value: object) -> float:
    if not isinstance(value, str):
        raise ValueError("write it with ms or s, such as 500ms")
    length = seconds(value)
    if not 0 < length <= LONGEST:
        raise ValueError(f"give more than 0 and at most {LONGEST:g}s")
    return length


def _ros_name(value: str) -> str:
    if not re.fullmatch(ROS_NAME_PATTERN, value):
        right = (
            f"did you mean '/{value}'?" if re.fullmatch(ROS_NAME_PATTERN, f"/{value}") else "such as /camera/image_raw"
        )
        raise ValueError(f"it must be a fully qualified topic name; {right}")
    return value


def _frame(value: str) -> str:
    if not re.fullmatch(r"[^\s/]\S{0,255}", value):
        raise ValueError("give a frame's name without spaces and without a slash in front, such as map")
    return value


def _file(value: str) -> str:
    if not value or "\0" in value:
        raise ValueError("give a path, such as /dev/video0")
    return value


Window = Annotated[float, BeforeValidator(_duration)]
Topic = Annotated[str, AfterValidator(_ros_name)]
Frame = Annotated[str, AfterValidator(_frame)]
File = Annotated[str, AfterValidator(_file)]
Coordinate = Annotated[float, Field(ge=-10_000, le=10_000, allow_inf_nan=False)]
Angle = Annotated[float, Field(ge=-math.tau, le=math.tau, allow_inf_nan=False)]
Size = Annotated[float, Field(gt=0.001, le=10, allow_inf_nan=False)]
Identity = Annotated[int, Field(ge=0, strict=True)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid")


class CameraPose(_Part):
    """The camera's place, in metres and radians: roll, pitch and yaw about the fixed axes (REP 103).

    The pose is that of the camera's body, which looks along its x axis like ``camera_link`` in REP 105's spirit: with a
    pitch of 1.5708 the camera looks down.
    """

    x: Coordinate
    y: Coordinate
    z: Coordinate
    roll: Angle = 0.0
    pitch: Angle
    yaw: Angle = 0.0


class Reference(_Part):
    """A marker that lies on the floor at a known place. The camera's pose is calculated from it."""

    id: Identity
    size: Size
    x: Coordinate
    y: Coordinate
    z: Coordinate = 0.0
    yaw: Angle = 0.0


class Device(_Part):
    """A camera of this machine (V4L), which the tracker reads itself."""

    path: File
    """The device, such as ``/dev/video0``. Another file is played as a video, in a loop."""
    calibration: File
    """The file with the camera's calibration, as ROS' camera_calibration writes it. A relative path is relative to the
    folder of the configuration. The image size in it is requested from the camera."""
    rate: Annotated[float, Field(ge=0.1, le=240, allow_inf_nan=False)] = 10.0
    """Maximum number of images that are processed per second."""
    format: Annotated[str, Field(pattern=r"^[A-Z0-9]{4}$")] | None = None
    """V4L2's four characters of the image format that the device sends, such as MJPG. If None, OpenCV chooses it."""


class Camera(_Part):
    """The camera and its place."""

    image: Topic | None = None
    """The topic of its images."""
    device: Device | None = None
    """Its device, if there is no topic."""
    info: Topic | None = None
    """The topic of its calibration. The default is ``camera_info`` beside the images, as in image_transport."""
    reliable: bool = False
    """Whether lost images are requested again, which large images over a network may need. The camera's publisher must
    be reliable too."""
    frame: Frame = "map"
    """The frame of the published poses. Its x and y axes lie in the floor."""
    pose: CameraPose | None = None
    references: list[Reference] = []

    @property
    def source(self) -> str:
        """The source of the images: a topic, or a file."""
        return self.device.path if self.device is not None else self.image or ""

    @property
    def calibration(self) -> str:
        """The source of the calibration: a topic, or a file."""
        if self.device is not None:
            return self.device.calibration
        return self.info or f"{(self.image or '').rpartition('/')[0]}/camera_info"

    @model_validator(mode="after")
    def _one_of(self) -> Camera:
        if (self.image is None) == (self.device is None):
            raise ValueError("set either 'image' (the topic of the images) or 'device' (a camera of this machine)")
        if self.device is not None and (self.info is not None or self.reliable):
            raise ValueError("'info' and 'reliable' are for images on a topic; a device has its calibration in a file")
        if (self.pose is None) == (not self.references):
            raise ValueError(
                "set either 'pose' (where the camera is) or 'references' (markers on the floor from which that is calculated)"
            )
        return self


class Mounting(_Part):
    """The place of a marker on its robot, in m and rad in the robot's own frame. At a yaw of 0 the marker's upper edge
    points to the robot's left.
    """

    x: Coordinate = 0.0
    y: Coordinate = 0.0
    yaw: Angle = 0.0


class Marker(_Part):
    """A marker on a robot that drives on the floor. The marker lies flat at a known height."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,62}$")]
    id: Identity
    size: Size
    """Length of the edge of its black square, in m."""
    height: Coordinate
    """Height above the floor, in m."""
    mounted: Mounting = Mounting()
    topic: Topic | None = None
    """The prefix of the robot's topics; the default is ``/tracker/NAME``."""
    frame: Frame | None = None
    """The robot's own frame; the default is its name."""

    @property
    def base(self) -> str:
        """The prefix of the robot's topics."""
        return self.topic or f"/tracker/{self.name}"


class Configuration(_Part):
    """The whole configuration of the tracker."""

    camera: Camera
    dictionary: Dictionary = "DICT_4X4_50"
    window: Window = 0.5
    """Seconds over which a velocity is measured."""
    noise: Annotated[float, Field(gt=0.001, le=10, allow_inf_nan=False)] = 0.2
    """Standard deviation of a marker's corner in the image, in pixels. The published covariances follow from it."""
    markers: Annotated[list[Marker], Field(min_length=1, max_length=100)]

    @field_validator("markers")
    @classmethod
    def _different(cls, markers: list[Marker]) -> list[Marker]:
        for field in ("name", "id", "base"):
            values = [getattr(marker, field) for marker in markers]
            for value in values:
                if values.count(value) > 1:
                    what = "topic" if field == "base" else field
                    raise ValueError(f"two markers have the {what} {value!r}; give each its own")
        return markers

    @model_validator(mode="after")
    def _in_dictionary(self) -> Configuration:
        known = {
            "DICT_ARUCO_ORIGINAL": 1024,
            "DICT_APRILTAG_16h5": 30,
            "DICT_APRILTAG_25h9": 35,
            "DICT_APRILTAG_36h10": 2320,
            "DICT_APRILTAG_36h11": 587,
        }
        size = known.get(self.dictionary) or int(self.dictionary.rpartition("_")[2])
        named = {marker.id: f"markers ({marker.name})" for marker in self.markers}
        for reference in self.camera.references:
            if reference.id in named:
                raise ValueError(f"camera.references: id {reference.id} is that of {named[reference.id]} too")
            named[reference.id] = "camera.references"
        for number, place in named.items():
            if number >= size:
                raise ValueError(f"{place}: id {number} is not in {self.dictionary}, which has 0 to {size - 1}")
        return self


def from_yaml(text: str, source: str, right: str) -> Any:
    """Parse a text; ``right`` says what is expected. Raises ConfigurationError."""
    try:
        return yaml.safe_load(text)
    except (
        yaml.YAMLError,
        ValueError,
        OverflowError,
    ) as error:  # the last two for dates such as 2020-13-45, and for escapes
        raise ConfigurationError(f"{source} is no YAML: {error}") from error
    except RecursionError as error:
        raise ConfigurationError(f"{source}: lists and mappings are nested too deeply; give {right}") from error


def load(text: str, source: str = "the configuration") -> Configuration:
    """Return the configuration in a YAML text. Raises ConfigurationError with all problems."""
    found = from_yaml(text, source, "a mapping with camera and markers")
    if not isinstance(found, Mapping):
        kind = "nothing" if found is None else type(found).__name__
        raise ConfigurationError(f"{source}: found {kind}; give a mapping with camera and markers")
    try:
        return Configuration.model_validate(found)
    except ValidationError as error:
        raise ConfigurationError("\n".join(f"{source}: {_problem(entry)}" for entry in error.errors())) from error


def read(file: Path) -> Configuration:
    """Return the configuration in a file. Raises ConfigurationError."""
    try:
        text = file.read_text()
    except OSError as error:
        raise ConfigurationError(
            f"{file} cannot be read: {error.strerror}; give a file that says which camera and which markers"
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{file} cannot be read: it is not UTF-8; save it as UTF-8 text") from error
    found = load(text, str(file))
    if (device := found.camera.device) is not None:
        device.calibration = str(file.parent / device.calibration)
    return found


def _problem(entry: Any) -> str:
    """Return a pydantic error in one line: the field, what was found, what is expected."""
    place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in entry["loc"]).removeprefix(".")
    message, found = entry["msg"].removeprefix("Value error, "), entry["input"]
    if entry["type"] == "missing":
        return f"{place}: missing"
    if entry["type"] == "extra_forbidden":
        return f"{place}: unknown field{did_you_mean(str(entry['loc'][-1]), _siblings(entry['loc'][:-1]))}"
    if isinstance(found, Mapping | list | BaseModel):
        return f"{place}: {message}" if place else message
    return f"{place}: found {found!r}; {message}"


def _siblings(place: tuple[int | str, ...]) -> list[str]:
    """Return the names of the fields of the part at a place."""
    model: type[BaseModel] = Configuration
    inner: dict[str, type[BaseModel]] = {
        "camera": Camera,
        "device": Device,
        "markers": Marker,
        "pose": CameraPose,
        "references": Reference,
        "mounted": Mounting,
    }
    for part in place:
        model = inner.get(str(part), model)
    return list(model.model_fields)

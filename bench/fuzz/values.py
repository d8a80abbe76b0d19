"""Scalars: those that fields have, and those that nobody expects there."""

from __future__ import annotations

from typing import Any

from hypothesis import strategies as st

from tests.support.nested_values import PLACE

Strategy = st.SearchStrategy[Any]

SLOTS = 4
"""Objects of each kind that exist all the time, so that updates and references find one."""

OWN = "fz"
"""Begins the names of all generated objects."""

LIVE = "robot-9-drive"
"""The workload whose monitor is given generated content."""

NEIGHBOUR = "robot-1-drive"
"""The workload in the same namespace that must not notice anything."""


def slot(kind: str, number: int) -> str:
    """Return the name of an object that exists all the time."""
    return f"{OWN}-{kind.lower()}-{number}"


def referred(kind: str) -> Strategy:
    """Return names that an object may refer to: objects that exist, its own kind, other kinds, and none."""
    known = [slot(kind, number) for number in range(SLOTS)]
    others = [slot(other, 0) for other in ("RobotWorkload", "FailurePolicy", "FallbackPool", "ConfigMap")]
    return st.sampled_from([*known, *known, *others, "quickstart-executing", LIVE, "nobody", "a.b-c"])


CHARACTERS = (
    "\x00", "\x01\x08\x1b[2J\x1b]0;owned\x07", "\r\n", "\u2028\u2029", "\u202e\u2066", "\ufeff", "\ufffe\uffff", "\U0010ffff",
    "\ud800", "e\u0301" * 40, "\u0660\u0661", "\u00a0", "\u200b", "'", '"', "\\", "`$(reboot)`", "{{ .Values }}", "%s%n", "\t",
)  # fmt: skip
"""Control characters, ends of lines, directions, halves of characters, combined ones, other digits, spaces and quotes."""

NUMBERS: tuple[Any, ...] = (
    0, -1, 1, 2**31 - 1, 2**31, -(2**31) - 1, 2**53 + 1, 2**63 - 1, 2**63, -(2**63) - 1, 2**64, 10**100,
    0.1, -0.0, 1e-320, 1e308, -1e308, 1e22,
)  # fmt: skip

LIKE_NUMBERS = (
    "NaN", ".nan", "-.inf", "Infinity", "1e400", "0x" + "f" * 300, "0b1", "1_000", "١٢٣", "0777", "-0", "+1", "1e-400",
    "9" * 400, "0." + "0" * 400 + "1", "1,5", "",
)  # fmt: skip

DURATIONS = ("0s", "1ms", "10ms", "50ms", "100ms", "500ms", "1s", "2s", "10s", "30s", "1m30s", "1h", "24h", "0.5s")

LONG_DURATIONS = (
    "9" * 30 + "h", "0.00000000000000000001ms", "99999999h", "1h1m1s1ms", "1s" * 16, "0ms0s0m0h", "876000h", "300000000h",
    "00000000000000000000000000001s",
)  # fmt: skip
"""Extreme durations that match the pattern of a duration."""

EXTREME_DURATIONS = (
    *LONG_DURATIONS, "1e3s", "-1s", "1", "s",
    " 1s", "1s\n", "١s", "1.s", ".5s", "1d", "Infinitys",
)  # fmt: skip

QUANTITIES = ("1", "500m", "1.5", "200Mi", "1Gi", "1e3", "0", "10M")

EXTREME_QUANTITIES = (
    "9" * 20 + "E",
    "1e99",
    "1e-99",
    "1n",
    "-1",
    "1Ei" * 2,
    "0.000000000000000001",
    "NaN",
    "1 Gi",
    "",
    "1e999",
)

ROS_NAMES = (
    "/cmd_vel",
    "/scan",
    "/odom",
    "/tf",
    "/map",
    "/amcl",
    "/dock",
    "/a/b/c",
    "/diagnostics",
    "/battery_state",
    "/navigate",
)

ROS_TYPES = (
    "geometry_msgs/msg/Twist", "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry", "std_msgs/msg/String", "std_srvs/srv/Trigger",
    "std_srvs/srv/SetBool", "nav2_msgs/action/NavigateToPose", "tf2_msgs/msg/TFMessage", "diagnostic_msgs/msg/DiagnosticArray",
    "a/msg/B",
)  # fmt: skip

EXTREME_NAMES = (
    "/",
    "//",
    "relative",
    "/" + "a/" * 120,
    "/a b",
    "/~private",
    "/é",
    "/1",
    "/a/" + "x" * 240,
    "~",
    "/a\n",
    "/{x}",
    "/../..",
)

LARGE_TEXTS = (
    "x" * 5000,
    "a" * 70_000,
    "(" * 1000,
    "[" * 3000,
    "{" * 3000,
    "é" * 3000,
    "\n" * 2000,
    "&a " * 1000,
    "0" * 20_000,
)

FRAGMENTS = (
    "",
    "x",
    "a-b",
    "true",
    "null",
    "~",
    "0",
    "-",
    "/",
    ":",
    "#",
    "{}",
    "[]",
    "*a",
    "&a",
    "!!binary",
    "<<",
    "{x}",
    "=1+1",
)


def one_of(*choices: Any) -> Strategy:
    """Return a strategy of some values."""
    return st.sampled_from(choices)


texts = st.one_of(
    one_of(*FRAGMENTS), one_of(*CHARACTERS), one_of(*LIKE_NUMBERS), st.text(max_size=12), one_of(*EXTREME_NAMES)
)
"""Short texts that are rarely what a field needs."""

hostile_texts = st.one_of(texts, one_of(*LARGE_TEXTS), one_of(*EXTREME_DURATIONS), one_of(*EXTREME_QUANTITIES))
"""Texts of any length."""

numbers = st.one_of(one_of(*NUMBERS), st.integers(-5, 200), st.floats(allow_nan=False, allow_infinity=False, width=32))

durations = st.one_of(one_of(*DURATIONS), one_of(*DURATIONS), one_of(*EXTREME_DURATIONS))

quantities = st.one_of(one_of(*QUANTITIES), one_of(*QUANTITIES), one_of(*EXTREME_QUANTITIES))

names = st.one_of(one_of(*ROS_NAMES), one_of(*ROS_NAMES), one_of(*EXTREME_NAMES))

types = st.one_of(one_of(*ROS_TYPES), one_of(*ROS_TYPES), texts)

structures: Strategy = st.recursive(
    st.one_of(st.none(), st.booleans(), numbers, texts),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(texts, inner, max_size=4)),
    max_leaves=12,
)
"""Values of JSON of any form."""


MANY_ERRORS = 2000
"""Most elements of a list or a map where the schema may refuse each of them. The API server compares each such error with all others,
for every kind of a CustomResourceDefinition: 250,000 keep one of its processors busy for an hour, whatever Understudy does."""


def _huge(what: str, most: int) -> Any:
    """Return a value nearly as large as an object can be, of at most so many elements that a schema may refuse."""
    match what:
        case "zeros":
            return [0] * min(400_000, most)
        case "lists":
            return [[]] * min(250_000, most)
        case "texts":
            return ["é"] * min(100_000, most)
        case "keys":
            return {f"k{i}": [i] for i in range(min(60_000, most))}
        case "labels":
            return {f"label-{i}": "" for i in range(60_000)}
        case "text":
            return "x" * 1_200_000
    return "\x00\u2028" * 90_000


def _large_structures(most: int) -> Strategy:
    return st.one_of(
        st.builds(lambda count: {f"key-{i}": i for i in range(min(count, most))}, one_of(100, 1000, 5000)),
        st.builds(lambda count: [0] * min(count, most), one_of(100, 10_000)),
        st.builds(lambda count: [{"a": [{}]}] * count, one_of(10, 1000)),
        st.just(PLACE),
        st.builds(lambda text, count: {text: {text: [text] * count}}, texts, one_of(1, 100)),
        one_of({}, [], [[[[]]]], {"": {"": {"": ""}}}),
        one_of("zeros", "lists", "texts", "keys", "labels", "text", "escapes").map(lambda what: _huge(what, most)),
    )


large_structures = _large_structures(1_000_000)
"""Large, deep and empty values of JSON, for fields whose content no schema describes. PLACE becomes a value that is nested more deeply than
Python can read."""

hostile = st.one_of(structures, numbers, hostile_texts, _large_structures(MANY_ERRORS))
"""Anything, for any field."""

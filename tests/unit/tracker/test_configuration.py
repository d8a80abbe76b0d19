"""The tracker's file: what it may say, and that every mistake is named with its field and what would be right."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from understudy.tracker.configuration import ConfigurationError, load, read
from understudy.tracker.process import main

GOOD = """
camera:
  image: /ceiling/image_raw
  pose: {x: 0, y: 0, z: 3, pitch: 1.5708}
markers:
  - {name: robot, id: 7, size: 0.2, height: 0.25}
"""


def with_(path: str, value: str) -> str:
    """GOOD with another value at a place; an empty one is left out."""
    found = yaml.safe_load(GOOD)
    *above, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    part = found
    for key in above:
        part = part[key]
    if value:
        part[last] = yaml.safe_load(value)
    else:
        del part[last]
    return yaml.safe_dump(found)


def test_omitted_fields_have_defaults():
    found = load(GOOD)
    (marker,) = found.markers
    assert found.camera.calibration == "/ceiling/camera_info"
    assert (found.camera.frame, found.window, found.dictionary) == ("map", 0.5, "DICT_4X4_50")
    assert (marker.base, marker.mounted.x) == ("/tracker/robot", 0.0)
    assert load(with_("window", "400ms")).window == 0.4
    assert load(with_("camera.info", "/info")).camera.calibration == "/info"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "found nothing; give a mapping with camera and markers"),
        ("- a", "found list; give a mapping with camera and markers"),
        (with_("camera", ""), "camera: missing"),
        (with_("markers.0.height", ""), "markers[0].height: missing"),
        (with_("camera.image", "image_raw"), "camera.image: found 'image_raw'; .*did you mean '/image_raw'"),
        (with_("camera.imgae", "/a"), "camera.imgae: unknown field, did you mean 'image'"),
        (with_("markers.0.hieght", "1"), "markers[0].hieght: unknown field, did you mean 'height'"),
        (with_("camera.pose.z", "high"), "camera.pose.z: found 'high'; .*number"),
        (with_("camera.pose.z", ".nan"), "camera.pose.z: found nan; .*"),
        (with_("camera.pose", ""), "camera: set either 'pose' .* or 'references'"),
        (with_("window", "500"), "window: found 500; write it with ms or s, such as 500ms"),
        (with_("window", "1h"), "window: found '1h'; give more than 0 and at most 10s"),
        (with_("dictionary", "ARUCO"), "dictionary: found 'ARUCO'; .*DICT_4X4_50"),
        (with_("markers.0.size", "-0.2"), "markers[0].size: found -0.2; .*greater than"),
        (with_("markers.0.id", "seven"), "markers[0].id: found 'seven'; .*integer"),
        (with_("markers.0.id", "50"), "markers (robot): id 50 is not in DICT_4X4_50, which has 0 to 49"),
        (with_("markers.0.name", "a b"), "markers[0].name: found 'a b'; .*"),
        (with_("markers", "[]"), "markers: .*at least 1 item"),
        (
            GOOD + "  - {name: other, id: 7, size: 0.2, height: 0.25}\n",
            "markers: two markers have the id 7; give each its own",
        ),
        (
            GOOD + "  - {name: other, id: 8, size: 0.2, height: 0.25, topic: /tracker/robot}\n",
            "markers: two markers have the topic '/tracker/robot'; give each its own",
        ),
        (
            with_("camera", "{image: /i, references: [{id: 7, size: 0.2, x: 0, y: 0}]}"),
            "camera.references: id 7 is that of markers (robot) too",
        ),
        ("{", "a.yaml is no YAML: .*"),
        ("camera: 2020-13-45", "a.yaml is no YAML: month must be in 1..12"),
        pytest.param("[" * 5000, "a.yaml: lists and mappings are nested too deeply", id="deep"),
    ],
)
def test_a_mistake_is_reported_with_its_field(text: str, expected: str):
    with pytest.raises(ConfigurationError) as caught:
        load(text, "a.yaml")
    pattern = re.escape(expected).replace(r"\.\*", ".*")
    assert any(re.match(f"(a.yaml: )?{pattern}", line) for line in str(caught.value).splitlines()), str(caught.value)


def test_all_mistakes_are_reported_at_once():
    with pytest.raises(ConfigurationError) as caught:
        load("camera: {image: image}\nmarkers: [{name: robot}]", "a.yaml")
    assert [line.split(":")[1].strip() for line in str(caught.value).splitlines()] == [
        "camera.image",
        "markers[0].id",
        "markers[0].size",
        "markers[0].height",
    ]


def test_the_command_reports_the_mistakes_in_its_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "tracker.yaml"
    assert main([str(file), "--check"]) == 2
    assert_golden("tracker", capsys.readouterr().err.replace(str(file), "FILE"), "FILE", "No such file")
    file.write_bytes(b"\xff\xfe")
    assert main([str(file), "--check"]) == 2
    assert_golden("tracker", capsys.readouterr().err.replace(str(file), "FILE"), "FILE", "UTF-8")
    file.write_text(with_("markers.0.height", ""))
    assert main([str(file)]) == 2
    assert capsys.readouterr().err == f"{file}: markers[0].height: missing\n"
    file.write_text(GOOD)
    assert main([str(file), "--check"]) == 0
    assert read(file).markers[0].id == 7


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(
                ["camera", "markers", "pose", "references", "id", "size", "height", "name", "window", "x", "a"]
            ),
            inner,
            max_size=4,
        )
    ),
    max_leaves=12,
)


def used_or_refused(text: str) -> None:
    message = ""
    try:
        load(text)
    except ConfigurationError as error:
        message = str(error)
    else:
        return
    assert message


@settings(max_examples=300, deadline=None)
@given(found=ANYTHING)
def test_any_file_is_used_or_refused_with_a_message(found: object):
    used_or_refused(yaml.safe_dump(found, allow_unicode=True))


@settings(max_examples=200, deadline=None)
@given(
    place=st.sampled_from(["camera", "camera.pose", "markers", "markers.0", "markers.0.mounted", "window"]),
    found=ANYTHING,
)
def test_a_part_of_a_wrong_type_is_refused_with_a_message(place: str, found: object):
    text = yaml.safe_load(GOOD)
    *above, last = [int(part) if part.isdigit() else part for part in place.split(".")]
    part = text
    for key in above:
        part = part[key]
    part[last] = found
    used_or_refused(yaml.safe_dump(text, allow_unicode=True))

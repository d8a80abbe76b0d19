from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from navigation_stack import maps
from navigation_world import generate
from navigation_world.files import write

from tests.unit.navigation_stack.drives import charted


def test_the_files_of_a_world_contain_its_map(tmp_path: Path) -> None:
    world = generate(7)
    write(world, tmp_path)
    found, wanted = maps.read(tmp_path / "map.yaml"), charted(world)
    assert np.array_equal(found.cells, wanted.cells)
    assert (found.resolution, found.x, found.y) == (wanted.resolution, wanted.x, wanted.y)


GOOD = "image: map.pgm\nresolution: 0.1\norigin: [0, 0, 0]\n"


@pytest.mark.parametrize(
    ("about", "picture", "message"),
    [
        ("image: map.pgm\norigin: [0, 0, 0]\n", b"P5\n1 1\n255\n\0", "map.yaml: resolution is missing"),
        (GOOD + "mode: scale\n", b"P5\n1 1\n255\n\0", "mode: found 'scale', only trinary is read"),
        ("image: map.pgm\nresolution: 0.1\norigin: [0, 0, 1]\n", b"P5\n1 1\n255\n\0", "a map that is turned by 1.0"),
        (GOOD, b"P2\n1 1\n255\n0\n", "map.pgm: no binary portable greymap"),
        (GOOD, b"P5\n4 4\n255\n\0", "16 pixels are said, found 1 bytes"),
        (GOOD, None, "No such file"),
        ("[]", b"", "a mapping is needed"),
    ],
)
def test_an_invalid_map_is_refused_with_the_reason(
    tmp_path: Path, about: str, picture: bytes | None, message: str
) -> None:
    (tmp_path / "map.yaml").write_text(about)
    if picture is not None:
        (tmp_path / "map.pgm").write_bytes(picture)
    with pytest.raises(ValueError, match=message.replace("(", r"\(")) as error:
        maps.read(tmp_path / "map.yaml")
    assert "map.yaml" in str(error.value)

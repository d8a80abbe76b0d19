"""Maps from files, as Nav2's map server reads them: a YAML file beside a greyscale picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from navigation_stack.grid import Grid


def read(file: Path) -> Grid:
    """The map of a YAML file in mode trinary. Raises ValueError that says what is wrong with which file."""
    try:
        about = yaml.safe_load(file.read_text())
        if not isinstance(about, dict):
            raise ValueError("a mapping is needed")
        image, resolution = about["image"], float(about["resolution"])
        x, y, turn = (float(number) for number in about["origin"])
        occupied, free = float(about.get("occupied_thresh", 0.65)), float(about.get("free_thresh", 0.25))
        if about.get("mode", "trinary") != "trinary":
            raise ValueError(f"mode: found {about['mode']!r}, only trinary is read")
        if turn:
            raise ValueError(f"origin: found a map that is turned by {turn}, only 0 is read")
        grey = _picture(file.parent / image)
    except KeyError as error:
        raise ValueError(f"{file}: {error.args[0]} is missing") from None
    except (OSError, TypeError, ValueError, yaml.YAMLError) as error:
        raise ValueError(f"{file}: {error}") from None
    dark = _darkness(grey, about)
    cells = np.full(grey.shape, -1, np.int8)
    cells[dark > occupied] = 100
    cells[dark < free] = 0
    return Grid(np.ascontiguousarray(cells[::-1]), resolution, x, y)


def _darkness(grey: NDArray[np.uint8], about: dict[str, Any]) -> NDArray[np.float64]:
    light: NDArray[np.float64] = grey / np.float64(255)
    return light if about.get("negate") else 1 - light


def _picture(file: Path) -> NDArray[np.uint8]:
    """A binary portable greymap, which needs no library."""
    data = file.read_bytes()
    fields: list[bytes] = []
    position = 0
    while len(fields) < 4:
        end = data.find(b"\n", position)
        if end < 0:
            raise ValueError(f"{file.name}: no binary portable greymap (P5)")
        fields += data[position:end].split(b"#")[0].split()
        position = end + 1
    if fields[0] != b"P5" or fields[3] != b"255":
        raise ValueError(f"{file.name}: no binary portable greymap (P5) of 8 bits")
    columns, rows = int(fields[1]), int(fields[2])
    if len(data) - position < rows * columns:
        raise ValueError(f"{file.name}: {rows * columns} pixels are said, found {len(data) - position} bytes")
    return np.frombuffer(data, np.uint8, rows * columns, position).reshape(rows, columns)

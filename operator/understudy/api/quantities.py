"""Amounts of CPU and memory as Kubernetes writes them: ``250m``, ``1.5``, ``200Mi``, ``1e3`` (apimachinery, ``resource.Quantity``)."""

from __future__ import annotations

import math
import re
from decimal import Decimal

QUANTITY = r"(?:[0-9]{1,20}(?:\.[0-9]{0,20})?|\.[0-9]{1,20})(?:[eE][-+]?[0-9]{1,2}|[numkMGTPE]|[KMGTPE]i)?"
"""Pattern of a quantity that is not negative."""

_PARTS = re.compile(r"([+-]?[0-9]*\.?[0-9]+|[+-]?[0-9]+\.)([eE][+-]?[0-9]{1,3}|[numkMGTPE]|[KMGTPE]i)?")
_SUFFIXES = {
    **{suffix: Decimal(10) ** (3 * power) for power, suffix in enumerate(("n", "u", "m", "", "k", "M", "G", "T", "P", "E"), -3)},
    **{f"{suffix}i": Decimal(1024) ** power for power, suffix in enumerate("KMGTPE", 1)},
}  # fmt: skip


def amount(quantity: str) -> Decimal:
    """Return a quantity such as ``1500m`` or ``256Mi`` as an exact number of cores or bytes.

    Raises ValueError if the text is not a quantity.
    """
    found = _PARTS.fullmatch(quantity)
    if found is None:
        raise ValueError(f"{quantity!r:.60} is not a quantity: write a number with a suffix, such as 500m or 256Mi")
    number, suffix = Decimal(found[1]), found[2] or ""
    if suffix[-1:].isdigit():  # an exponent
        return number.scaleb(int(suffix[1:]))
    return number * _SUFFIXES[suffix]


def binary_quantity(number: int | Decimal) -> str:
    """Return a number of bytes as Kubernetes writes it, such as ``2080Mi``, rounded up to whole KiB."""
    found, suffix = math.ceil(Decimal(number) / 1024), "Ki"
    for larger in ("Mi", "Gi"):
        if found % 1024:
            break
        found, suffix = found // 1024, larger
    return f"{found}{suffix}"

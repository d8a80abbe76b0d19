"""Metrics in the text format of Prometheus: sums of samples by their labels, and increases between two readings."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass

_SAMPLE = re.compile(r"^([a-zA-Z_:][a-zA-Z0-9_:]*)(?:\{(.*)\})? (\S+)")
_LABEL = re.compile(r'([a-zA-Z_][a-zA-Z0-9_]*)="((?:[^"\\]|\\.)*)"')

Labels = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Reading:
    """Samples by name and labels."""

    samples: Mapping[tuple[str, Labels], float]

    def total(self, name: str, **labels: str | Collection[str]) -> float:
        """Return the sum of a metric's samples with these labels. A collection matches any of its values."""
        return sum(
            value for (found, has), value in self.samples.items() if found == name and _matches(dict(has), labels)
        )

    def by(self, name: str, label: str) -> dict[str, float]:
        """Return a metric's sums by one of its labels, without those that are 0."""
        sums: dict[str, float] = {}
        for (found, has), value in self.samples.items():
            if found == name and value:
                key = dict(has).get(label, "")
                sums[key] = sums.get(key, 0.0) + value
        return sums

    def since(self, before: Reading) -> Reading:
        """Return the increase of each sample since another reading. A sample that is smaller now was reset."""
        return Reading(
            {
                key: value - then if value >= (then := before.samples.get(key, 0.0)) else value
                for key, value in self.samples.items()
            }
        )


def _matches(has: Mapping[str, str], wanted: Mapping[str, str | Collection[str]]) -> bool:
    return all(
        has.get(label, "") == value if isinstance(value, str) else has.get(label, "") in value
        for label, value in wanted.items()
    )


def read(text: str, names: Collection[str]) -> Reading:
    """Return the samples with one of these names."""
    samples: dict[tuple[str, Labels], float] = {}
    for line in text.splitlines():
        if line.startswith("#") or (match := _SAMPLE.match(line)) is None or match[1] not in names:
            continue
        labels = tuple(sorted((label, value) for label, value in _LABEL.findall(match[2] or "")))
        samples[match[1], labels] = float(match[3])
    return Reading(samples)

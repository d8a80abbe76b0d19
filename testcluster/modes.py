"""The modes of a node's network: weaknesses that networks of real clusters have."""

import json
from dataclasses import dataclass


@dataclass(frozen=True)
class NetworkModes:
    """What a node's enforcer of network policies does worse than it could. By default nothing.

    Attributes:
        established: flows live on of which a packet was let through before, until their pod is deleted.
        deaf: no change of the cluster is applied; what was missed is applied when the mode ends.
        lag: the delay of each change, in milliseconds.
        keep_vanished: a pod whose object is deleted before its network keeps what it was allowed last.
        label_lag: the delay of changes of the labels of pods and namespaces, in seconds. Until then, no change of a policy is
            applied to these pods. Labels of pods whose keys begin with ``annotation`` are applied at once. Cilium does the same.
    """

    established: bool = False
    deaf: bool = False
    lag: int = 0
    keep_vanished: bool = False
    label_lag: float = 0.0

    def __post_init__(self) -> None:
        if self.lag < 0 or self.label_lag < 0:
            raise ValueError("a lag of the network is negative")

    def __str__(self) -> str:
        found = [
            *(["established flows live on"] if self.established else []),
            *(["deaf"] if self.deaf else []),
            *([f"lag {self.lag} ms"] if self.lag else []),
            *(["vanished pods keep their policy"] if self.keep_vanished else []),
            *([f"labels lag {self.label_lag:g} s"] if self.label_lag else []),
        ]
        return ", ".join(found) or "none"

    def to_json(self) -> str:
        """Return the file that the enforcer reads (netpol/internal/enforcer/modes.go)."""
        return json.dumps(
            {
                "established": self.established,
                "deaf": self.deaf,
                "lagMilliseconds": self.lag,
                "keepVanished": self.keep_vanished,
                "labelLagSeconds": self.label_lag,
            }
        )

    @classmethod
    def from_json(cls, text: str) -> "NetworkModes":
        """Return the modes of a file."""
        found = json.loads(text)
        return cls(
            established=found["established"],
            deaf=found["deaf"],
            lag=found["lagMilliseconds"],
            keep_vanished=found["keepVanished"],
            label_lag=found["labelLagSeconds"],
        )

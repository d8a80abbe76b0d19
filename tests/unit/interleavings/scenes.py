"""What runs begin from and end with: scenes, and the outcome of a run."""

from __future__ import annotations

from dataclasses import dataclass, field

ROBOTS = "192.0.2.1/32"
"""Where robots with a reflex are: outside of the cluster."""


ON_BOARD = "home"
"""The instance on board of a robot with a mux."""


@dataclass(frozen=True)
class Scene:
    """What there is: workloads, and the pools that their policy names."""

    name: str
    workloads: int
    strategies: tuple[str, ...]
    spares: int = 0
    standbys: int = 0
    initializes: bool = False
    """Whether standbys wait initialized, and not executing."""
    activates: bool = False
    """Whether an application has to be brought up by a procedure before it sends."""
    refers: str = ""
    """The kind of what workloads refer to, where they have no template."""
    updates: tuple[tuple[str, str | int], ...] = ()
    """The updateStrategy of the shared pool; none where it is empty."""
    sizing: tuple[tuple[str, str | int | float], ...] = ()
    """The sizing of the shared pool, instead of so many spares."""
    troubles: tuple[str, ...] = ()
    """All that goes wrong with processes and pods; everything, where nothing is named."""
    weather: tuple[float, ...] = (0.0, 0.5, 1.0, 2.0, 3.0)
    """How bad the network may be."""
    safely: bool = False
    """Whether robots receive safe commands while nobody drives."""
    keeps: bool = False
    """Whether the state of applications is kept."""
    reflex: str = ""
    """The deadline of the robots' readers, or of the muxes; no reflex where it is empty."""
    tasks: str = ""
    """What happens to goals at a failover (``onFailover``); no tasks where it is empty."""
    muxed: bool = False
    """Whether the gates are of kind Mux, and a mux at each robot forwards the instance in control."""
    on_board: str = ""
    """After which silence the mux forwards an instance on board, which always reaches it; none where it is empty."""

    @property
    def workload_names(self) -> list[str]:
        return [f"robot-{number}" for number in range(1, self.workloads + 1)]


SCENES = (
    Scene("shared", workloads=3, strategies=("spare", "Restart"), spares=2),
    Scene("scarce", workloads=2, strategies=("spare", "Restart"), spares=1, keeps=True),
    Scene("executing", workloads=2, strategies=("hot", "Restart"), standbys=1, safely=True),
    Scene("initialized", workloads=2, strategies=("hot", "Restart"), standbys=1, initializes=True),
    Scene("referred", workloads=2, strategies=("hot", "spare", "Restart"), spares=1, standbys=1, refers="Deployment"),
    Scene(
        "procedures",
        workloads=2,
        strategies=("hot", "spare", "Restart"),
        spares=1,
        standbys=1,
        initializes=True,
        activates=True,
        safely=True,
    ),
    Scene("stateful", workloads=2, strategies=("hot", "Restart"), standbys=1, refers="StatefulSet"),
    Scene("both", workloads=2, strategies=("hot", "spare", "Restart"), spares=1, standbys=1),
)


@dataclass
class Outcome:
    """The result of a run."""

    seed: int
    scene: str
    faults: list[str] = field(default_factory=list)
    """What didn't hold; the first one is what matters."""
    trace: list[str] = field(default_factory=list)
    steps: int = 0
    seconds: float = 0.0
    """Of virtual time."""
    claims: int = 0
    commits: int = 0
    creations: int = 0
    requests: dict[str, int] = field(default_factory=dict)
    reflex: dict[str, int] = field(default_factory=dict)
    """Its result; None if there is none."""
    tasks: dict[str, int] = field(default_factory=dict)
    """Numbers of goals; empty without tasks."""
    muxes: dict[str, int] = field(default_factory=dict)
    """What muxes did; empty without them."""

    def __str__(self) -> str:
        text = "\n".join([*self.trace, *(f"DOES NOT HOLD: {fault}" for fault in self.faults)])
        return f"seed {self.seed} ({self.scene}), {self.steps} steps, {self.seconds:.1f} s\n{text}"

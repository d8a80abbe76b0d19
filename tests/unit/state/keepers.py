"""A keeper of state, and what it is offered and gives."""

from __future__ import annotations

from understudy.api.kinds.state_spec import State
from understudy.state.state_capture import Keeper, Key, Standing

POSE = Key("Topic", "/amcl_pose")


MAP = Key("Topic", "/map")


TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"


START = 1_000_000.0


TICK = 0.05


def state(**fields: object) -> State:
    return State.model_validate(
        {"keep": [{"topic": "/amcl_pose", "restoreTo": "/initialpose", "stamp": "now"}]} | fields
    )


def offer(keeper: Keeper, at: float, data: bytes = b"", key: Key = POSE, *, standing: Standing = "") -> None:
    keeper.offer(key, data or repr(at).encode(), taken_at=at, received_at=at, type=TYPE, standing=standing)


def healthy(keeper: Keeper, start: float, end: float, *, every: float = TICK) -> None:
    """The tree holds from the first moment to the last, and a message comes just before each look."""
    for i in range(round((end - start) / every) + 1):
        now = start + i * every
        if i:
            offer(keeper, now)
        keeper.judge("Healthy", now)


def kept_at(keeper: Keeper, onset: float) -> float:
    (sample,) = keeper.select(onset).samples
    assert sample.data == repr(sample.taken_at).encode()
    return sample.taken_at


def reason(keeper: Keeper, onset: float) -> str:
    kept = keeper.select(onset)
    assert not kept.samples
    (left,) = kept.left_out
    assert not left.failed
    return left.reason


def total(keeper: Keeper) -> int:
    """Bytes of the texts that are held, each once."""
    return sum(
        len(data)
        for versions in keeper.versions().values()
        for data in {id(version.data): version.data for version in versions}.values()
    )

"""Commands that begin where the arm is, whoever has moved it there.

An instance is not told when its commands reach the arm, and one that stands by sends them all the time. What it does know
is what the arm follows: the controller says its reference. While that is one of the instance's own last commands, its
motion goes on as planned. While it is not, another instance moves the arm, or nobody does, and each command is one step
from where the arm is. So the first command that gets through is one step from the last one, and the arm never jumps.
"""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
from manipulation_arm import Joints

from manipulation_stack.motion import Command, Motion

LATELY = 0.1
"""s: a reference that was commanded longer ago is that of an arm which does not follow any more."""

PATIENCE = 1.0
"""s for which a motion rests, while the arm keeps saying that it does not follow, before it is taken back to where the arm is."""

REMEMBERED = 500
"""Commands that are still known as one's own: those of the last 10 s."""

OWN = 1e-7
"""rad that an instance's commands are off those of others at most. Two that go the same way would send the same ones otherwise,
and take those that another one is followed by for their own.
"""

ASIDE = 0.004
"""rad that the arm may be off the way and still be on it: less than a step at full speed."""


class Follower:
    """One motion of an instance that may or may not be in control."""

    def __init__(self, motion: Motion) -> None:
        self._motion = motion
        self._own = np.random.default_rng().uniform(0.0, OWN, motion.command().positions.shape)
        self._sent: OrderedDict[bytes, float] = OrderedDict()
        self._unfollowed = 0.0
        self._heard: Command | None = None
        self.strayed = False
        """Whether the arm is not on the way: another way is needed, from where it is."""

    @property
    def remaining(self) -> float:
        """What is left of the way."""
        return self._motion.remaining

    @property
    def arrived(self) -> bool:
        """Whether the last command is the end of the way."""
        return self._motion.arrived

    def replace(self, motion: Motion) -> None:
        """Take another way."""
        self._motion = motion

    def step(self, reference: Command, now: float, seconds: float) -> Command | None:
        """The next command, so many seconds after the one before; None while the arm is to stay wherever it is.

        ``reference`` is what the arm follows, the same object until the arm has said so again.
        """
        heard, self._heard = self._heard, reference
        # An arm that is held aside of the way follows as well, but not along the way.
        sent = None if self.strayed else self._sent.get(reference.positions.tobytes())
        if sent is not None and now - sent <= LATELY:
            self._unfollowed = 0.0
            command = self._of_its_own(self._motion.advance(seconds))
        elif sent is not None and self._unfollowed < PATIENCE:
            # An arm that says nothing is busy, and takes up later what it was sent meanwhile.
            self._unfollowed += seconds if reference is not heard else 0.0
            self._motion.rest()
            command = self._of_its_own(self._motion.command())
        else:
            place, aside = self._motion.off(reference.positions)
            self.strayed = aside > ASIDE
            if self.strayed:
                # Where it is by now it has not said yet: a moving arm would be called back to where it was.
                return None
            self._motion.begin(place, reference.velocities)
            command = self._of_its_own(self._motion.advance(seconds))
        self._note(command.positions, now)
        return command

    def _of_its_own(self, command: Command) -> Command:
        return Command(command.positions + self._own, command.velocities)

    def _note(self, positions: Joints, now: float) -> None:
        self._sent[positions.tobytes()] = now
        self._sent.move_to_end(positions.tobytes())
        while len(self._sent) > REMEMBERED:
            self._sent.popitem(last=False)

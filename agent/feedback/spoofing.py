"""A receiver whose fixes are known to be off: what the autopilot and the ground station are told of it. Sans-I/O.

ArduPilot is to take MAV_CMD_USER_1 for it (its pull request 33167, open: parameter 1 says whether the receiver is
spoofed, parameter 2 which one) and stops using it. PX4's command for sources (43006) is in no dialect that we have.
"""

from __future__ import annotations

from agent.mavlink.codec import mavlink

COMMAND = mavlink.MAV_CMD_USER_1
SURE_S, OVER_S = 1.0, 10.0
"""Off for so long before it is told, and not off for so long before it is taken back."""
RETRY_S, ATTEMPTS = 1.0, 5


class SpoofedReceiver:
    """What is known of the autopilot's own receiver."""

    def __init__(self) -> None:
        self.is_off = False
        """Whether its fixes are off, for long enough to say so."""
        self.off_m = 0.0
        """By how much, at last."""
        self._changing_since_s: float | None = None
        self._acknowledged = False
        """What the autopilot acknowledged last: whether its receiver is off."""
        self._attempts = 0
        self._asked_s = float("-inf")

    def reset(self) -> None:
        """Another life of the autopilot: it knows nothing of this."""
        self._acknowledged, self._attempts = False, 0

    @property
    def left_out(self) -> bool:
        """Whether the autopilot said that it no longer uses its receiver."""
        return self._acknowledged

    def observe(self, off_m: float | None, now_s: float) -> bool:
        """How far its fixes are off, ``None`` if nothing is known against them; whether that is news."""
        if off_m is not None:
            self.off_m = off_m
        if (off_m is not None) is self.is_off:
            self._changing_since_s = None
            return False
        if self._changing_since_s is None:
            self._changing_since_s = now_s
        if now_s - self._changing_since_s < (OVER_S if self.is_off else SURE_S):
            return False
        self.is_off, self._changing_since_s, self._attempts = not self.is_off, None, 0
        return True

    def due(self, host_s: float) -> bool:
        """Whether the autopilot is to be told now: at each change, until it acknowledges."""
        if self.is_off is self._acknowledged or self._attempts >= ATTEMPTS or host_s - self._asked_s < RETRY_S:
            return False
        self._attempts += 1
        self._asked_s = host_s
        return True

    def on_ack(self, accepted: bool) -> None:
        """An acknowledgement of the command."""
        if accepted and self._attempts:
            self._acknowledged = self.is_off
        elif self._attempts:
            self._attempts = ATTEMPTS  # it does not know the command

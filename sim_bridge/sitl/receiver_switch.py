"""Takes a simulated autopilot's GPS away and gives it back, by its simulator's own parameter. Sans-I/O.

PX4: SIM_GPS_USED, the satellites in sight; ArduPilot: SIM_GPS1_ENABLE. The value that was there is read first, so
that it can be put back.
"""

from __future__ import annotations

from agent.feedback.requirements import parameter_name
from agent.mavlink.codec import Message, mavlink

PARAMETERS = {"px4": "SIM_GPS_USED", "ardupilot": "SIM_GPS1_ENABLE"}
RETRY_S = 0.5


class ReceiverSwitch:
    """Of one autopilot."""

    def __init__(self, flavour: str) -> None:
        self.name = PARAMETERS[flavour]
        self._there: Message | None = None
        """What it was at first."""
        self._now: float | None = None
        """What it is, as it came."""
        self._asked_s = float("-inf")

    @property
    def known(self) -> bool:
        """Whether the autopilot has said that it has the parameter."""
        return self._there is not None

    @property
    def is_off(self) -> bool:
        """Whether the autopilot has said that its GPS is switched off."""
        return self._now == 0.0

    def on_value(self, message: Message) -> None:
        """A PARAM_VALUE of the autopilot."""
        if parameter_name(message) == self.name:
            self._now = float(message.param_value)
            if self._there is None:
                self._there = message

    def due(self, off: bool, system_id: int, component_id: int, now_s: float) -> Message | None:
        """What to send so that it is, or is not, ``off``; the answer to all of it is a PARAM_VALUE."""
        there = self._there
        if there is not None and self._now == (0.0 if off else there.param_value):
            return None
        if now_s - self._asked_s < RETRY_S:
            return None
        self._asked_s = now_s
        name = self.name.encode()
        if there is None:
            return mavlink.MAVLink_param_request_read_message(system_id, component_id, name, -1)
        value = 0.0 if off else float(there.param_value)  # zero is zero in both ways to send integers
        return mavlink.MAVLink_param_set_message(system_id, component_id, name, value, there.param_type)

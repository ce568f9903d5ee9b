"""What a replay gets wrong on request: the simulator's faults laid over what was recorded.

Fixes, accelerations and ranges change on their way to the agents, and members lie, as in the simulated world. What
the autopilot made of its sensors in flight (attitude, its own estimate) stays as it was.
"""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Sequence
from dataclasses import replace

import msgspec
import numpy as np

from agent.config.fields import Table
from agent.config.structs import read_struct
from agent.config.tables import FleetConfig
from agent.sensing.samples import GpsSample, ImuSample
from sim_bridge.faults.fault_tables import FaultTable, about, wrong_settings
from sim_bridge.faults.sensor_faults import SensorFaults
from sim_bridge.replay.errors import ReplayError
from sim_bridge.replay.side_files.range_files import RangeLine

OPTION = "--fault"
SPELLING = 'kind="gps_wrong", agents=[2], from_s=20, to_s=25, offset_m=[30, 0, 0] (docs/faults.md)'
LEAST_RANGE_M = 0.01



class _Asked(Table, frozen=True):
    fault: FaultTable


def parsed_faults(
    texts: Sequence[str], config: FleetConfig, flown: Collection[int], part_s: tuple[float, float]
) -> tuple[FaultTable, ...]:
    """The faults of options, each the keys of a ``[[sim.faults]]`` table in a line.

    ``flown`` are the drones with a log, ``part_s`` is what is replayed, from the start of the logs. Raises
    `ReplayError`.
    """
    faults = tuple(_parsed(text) for text in texts)
    for wrong in wrong_settings(faults, config, "fault"):
        raise ReplayError(_key(wrong.key), wrong.expected, wrong.found)
    for fault in faults:
        for agent_id in about(fault) - set(flown):
            expected = f"drones with a log ({', '.join(map(str, flown))})"
            raise ReplayError(f"{OPTION}: agents", expected, str(agent_id))
        if not max(fault.from_s, part_s[0]) < min(fault.end_s, part_s[1]):
            expected = f"a part of what is replayed, {part_s[0]:.1f} to {part_s[1]:.1f} s"
            raise ReplayError(OPTION, expected, f"{fault.from_s:.1f} to {fault.end_s:.1f} s")
    return faults


def _parsed(text: str) -> FaultTable:
    try:
        document = tomllib.loads(f"fault = {{ {text} }}")
    except tomllib.TOMLDecodeError as error:
        raise ReplayError(OPTION, SPELLING, repr(text)) from error
    asked, wrong = read_struct(document, _Asked)
    if asked is None:
        raise ReplayError(_key(wrong[0].key), wrong[0].expected, wrong[0].found)
    return asked.fault


def _key(key: str) -> str:
    """``fault.kind`` or ``fault[0].agents`` as the option's."""
    return f"{OPTION}: {key.rpartition('.')[2]}"


class Injection:
    """The faults of a replay; their zero is ``start_s`` in fleet time."""

    def __init__(self, faults: Sequence[FaultTable] = (), seed: int = 0, start_s: float = 0.0) -> None:
        self.faults = tuple(faults)
        self.start_s = start_s
        self._sensors = SensorFaults(self.faults, seed)

    def described(self) -> list[dict[str, object]]:
        """For the report, times in seconds from the start of the logs."""
        return [msgspec.to_builtins(fault) for fault in self.faults]

    def fix(self, agent_id: int, fix: GpsSample) -> GpsSample | None:
        """A fix as the receiver has it; ``None`` for none.

        The norm of a velocity is left as it was: nothing says where it points.
        """
        if not self.faults:
            return fix
        time_s = fix.t_s - self.start_s
        if self._sensors.gps_off(agent_id, time_s):
            return None
        position, velocity = self._sensors.gps_error(agent_id, time_s)
        north, east, down = np.add(fix.position_m, position).tolist()
        ground = fix.ground_velocity_mps
        if ground is not None:
            ground = (ground[0] + float(velocity[0]), ground[1] + float(velocity[1]))
        wrong = replace(fix, position_m=(north, east, down), ground_velocity_mps=ground)
        said = self._sensors.repeated(agent_id, time_s, wrong)
        return replace(said, t_s=fix.t_s, latency=fix.latency)

    def acceleration(self, agent_id: int, sample: ImuSample) -> ImuSample:
        """What the accelerometers say."""
        if not self.faults:
            return sample
        force = np.array(sample.specific_force_mps2)
        x, y, z = self._sensors.force(agent_id, sample.t_s - self.start_s, force).tolist()
        return ImuSample(sample.t_s, (x, y, z), sample.gyro_radps)

    def range(self, line: RangeLine) -> RangeLine:
        """What the modules measure."""
        ends, time_s = (line.observer, line.target), line.time_s - self.start_s
        error = self._sensors.range_error(*ends, time_s)
        range_m = line.range_m if error.extra_m == 0.0 else max(line.range_m + error.extra_m, LEAST_RANGE_M)
        said_m, target = self._sensors.said_m(*ends, time_s, range_m), self._sensors.said_of(*ends, time_s)
        if said_m == line.range_m and target == line.target:
            return line
        return replace(line, target=target, range_m=said_m)

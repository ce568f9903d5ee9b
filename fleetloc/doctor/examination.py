"""What is to be said of a drone's set-up, one line each, with what to do where something is wrong."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from agent.config.endpoints import LinkKind, parse_endpoint
from agent.config.tables import FleetConfig
from agent.feedback.feedback_table import FEEDBACK_FITS
from agent.log.disk import too_little_left
from agent.mavlink.codec import mavlink
from agent.mavlink.session import LinkState
from estimators.compiled.cache import cache_folder
from fleetloc.doctor.listening import Listened

SLOW_SHARE = 0.6
"""A stream below this share of what was asked for is too slow."""
MESSAGES = {
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: "HIGHRES_IMU",
    mavlink.MAVLINK_MSG_ID_RAW_IMU: "RAW_IMU",
    mavlink.MAVLINK_MSG_ID_SCALED_IMU: "SCALED_IMU",
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: "ATTITUDE_QUATERNION",
    mavlink.MAVLINK_MSG_ID_ATTITUDE: "ATTITUDE",
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: "GPS_RAW_INT",
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: "LOCAL_POSITION_NED",
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: "GLOBAL_POSITION_INT",
}


class Mark(StrEnum):
    """How a line stands."""

    GOOD = "ok"
    UNWISE = "warn"
    WRONG = "WRONG"


@dataclass(frozen=True, slots=True)
class Examined:
    """``what`` was looked at, what was ``found``, and what is ``to_do`` about it."""

    mark: Mark
    what: str
    found: str
    to_do: str = ""

    def __str__(self) -> str:
        text = f"{self.mark:<5} {self.what}: {self.found}"
        return f"{text}; {self.to_do}" if self.to_do else text


def of_computer(config: FleetConfig, warnings: list[str]) -> list[Examined]:
    """Configuration (already free of mistakes), clock, keys, disk and cache; ``warnings`` are those of `check`."""
    lines = [Examined(Mark.GOOD, "configuration", f"{len(config.ids)} drones; keys and clock pass `fleetloc check`")]
    lines += [Examined(Mark.UNWISE, "configuration", each) for each in warnings]
    lines.append(_disk(config))
    folder = cache_folder()
    compiled = folder.is_dir() and any(folder.iterdir())
    to_do = "" if compiled else "`fleetloc warmup`, or the first start takes a minute"
    found = f"kernels are in {folder}" if compiled else f"no kernels in {folder}"
    lines.append(Examined(Mark.GOOD if compiled else Mark.UNWISE, "cache", found, to_do))
    return lines


def of_autopilot(config: FleetConfig, agent_id: int, heard: Listened) -> list[Examined]:
    """Link, streams, clock, GPS and, where it is to be fed, parameters."""
    where = f"autopilot at {config.agent(agent_id).mavlink}"
    session = heard.onboard.autopilot
    if heard.unusable:
        return [Examined(Mark.WRONG, where, heard.unusable, "is the daemon running? one program can have the port")]
    if session.state is not LinkState.CONNECTED or session.autopilot is None:
        return [_no_autopilot(config, agent_id, heard, where)]
    found = f"{session.autopilot.flavour}, system {session.autopilot.system_id}, {session.heard} messages"
    lines = [Examined(Mark.GOOD, where, found)]
    return [*lines, *_streams(heard), _clock(heard), _gps(heard), *_feedback(config, heard)]


def _disk(config: FleetConfig) -> Examined:
    if config.record.directory is None:
        return Examined(Mark.GOOD, "disk", "nothing is recorded")
    folder = Path(config.record.directory)
    there = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    if not os.access(there, os.W_OK):
        to_do = "another record.directory, or its permissions"
        return Examined(Mark.WRONG, "disk", f"{there} cannot be written", to_do)
    little = too_little_left(there)
    if little:
        return Examined(Mark.WRONG, "disk", little, "delete old records")
    return Examined(Mark.GOOD, "disk", f"room in {there}")


def _no_autopilot(config: FleetConfig, agent_id: int, heard: Listened, where: str) -> Examined:
    """Why nobody was found, as far as it can be told."""
    session, decoder = heard.onboard.autopilot, heard.onboard.autopilot.decoder
    serial = parse_endpoint(config.agent(agent_id).mavlink).kind is LinkKind.SERIAL
    wanted = f"system {config.system_id(agent_id)}"
    if not heard.bytes_read:
        to_do = "is it on, wired (TX to RX), and its port set to MAVLink 2?"
        return Examined(Mark.WRONG, where, "nothing came", to_do)
    if not decoder.received:
        to_do = "the baud rate is another one, or the port speaks no MAVLink" if serial else "is that MAVLink?"
        bad = ", ".join(f"{count} {reason}" for reason, count in decoder.bad.items())
        return Examined(Mark.WRONG, where, f"{heard.bytes_read} bytes, no message ({bad or 'nothing'})", to_do)
    systems = [f"system {each}" for each in sorted(session.other_systems)]
    seen = ", ".join([*systems, *session.ignored]) or "no heartbeat"
    found = f"{decoder.received} messages, none of {wanted} ({seen})"
    return Examined(Mark.WRONG, where, found, "see agents.system_id")


def _streams(heard: Listened) -> Iterator[Examined]:
    rates = heard.onboard.autopilot.rates
    for message_id, name in MESSAGES.items():
        stream = rates.streams.get(message_id)
        if stream is None:
            continue
        if rates.refused(message_id):
            yield Examined(Mark.GOOD, name, "not sent by this firmware, the next best is asked for")
        elif stream.rate_hz is None:
            yield Examined(Mark.UNWISE, name, "not measured yet", "listen for longer (--listen)")
        elif stream.rate_hz < SLOW_SHARE * stream.wanted_hz:
            found = f"{stream.rate_hz:.1f} of {stream.wanted_hz:g} Hz"
            yield Examined(Mark.WRONG, name, found, "a faster port, fewer streams, or nobody else who sets rates")
        else:
            yield Examined(Mark.GOOD, name, f"{stream.rate_hz:.1f} Hz")


def _clock(heard: Listened) -> Examined:
    clock = heard.onboard.autopilot.clock
    if not clock.synchronised:
        return Examined(Mark.UNWISE, "TIMESYNC", "not answered", "stamps are of arrival then; is the link two-way?")
    rtt_ms = 1e3 * (clock.rtt_s or 0.0)
    return Examined(Mark.GOOD, "TIMESYNC", f"answered, round trip {rtt_ms:.1f} ms")


def _gps(heard: Listened) -> Examined:
    fix_type = heard.onboard.autopilot.samples.fix_type
    if fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX:
        return Examined(Mark.GOOD, "GPS", f"fix type {fix_type}")
    to_do = "outdoors, wait; the drone starts with its fixes"
    return Examined(Mark.UNWISE, "GPS", f"no fix (type {fix_type})", to_do)


def _feedback(config: FleetConfig, heard: Listened) -> Iterator[Examined]:
    """The parameters on which it depends whether the autopilot uses what it is given."""
    feeder, autopilot = heard.onboard.feeder, heard.onboard.autopilot.autopilot
    if feeder is None or autopilot is None:
        yield Examined(Mark.GOOD, "feedback", "off: the autopilot is given nothing")
        return
    if autopilot.flavour not in FEEDBACK_FITS[config.feedback.kind]:
        found = f'"{config.feedback.kind}" is not read by {autopilot.flavour}'
        yield Examined(Mark.WRONG, "feedback.kind", found, "another kind, or leave the drone out of feedback.agents")
        return
    for each in feeder.wanted:
        value = feeder.parameters.values.get(each.name)
        reboot = " and reboot" if each.reboot else ""
        if value is None:
            to_do = f"this firmware has none, or listen for longer; it should be {each.wanted}"
            yield Examined(Mark.UNWISE, each.name, "not told", to_do)
        elif each.holds(value):
            yield Examined(Mark.GOOD, each.name, f"{value:g}")
        else:
            mark = Mark.WRONG if each.needed else Mark.UNWISE
            yield Examined(mark, each.name, f"{value:g}", f"set it to {each.wanted}{reboot}: {each.why}")
    origin = feeder.watch.origin_m
    if origin is None:
        yield Examined(Mark.UNWISE, "its origin", "not told", "it has one with its first fix")
    else:
        north, east, down = origin
        yield Examined(Mark.GOOD, "its origin", f"{north:.1f} {east:.1f} {down:.1f} m from the fleet's (NED)")

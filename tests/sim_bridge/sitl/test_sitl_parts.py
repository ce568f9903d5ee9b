"""The bridge's parts without sockets: frames cut, truths dated, missions and addresses checked."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from agent.errors import ConfigError
from agent.sensing.frames import FleetFrame
from fleetloc.errors import InputError
from fleetloc.run.gps_drops import gps_outage
from sim_bridge.replay.errors import ReplayError
from sim_bridge.sitl.frames import FrameSplitter, message_id, split_datagram
from sim_bridge.sitl.mission import MissionError, load_mission
from sim_bridge.sitl.ports import packed
from sim_bridge.sitl.session import SitlSession, TimedTruth
from sim_bridge.sitl.setup import vehicle_links
from sim_bridge.sitl.sitl_table import COMPONENT_ID, sitl_table
from sim_bridge.sitl.truth import TruthTap
from sim_bridge.world.simulation import Simulation
from tests.support.loopback_sitl import FRAME, grounded_fleet
from tests.support.sitl_fleet import fleet_config

GPS = mavlink.MAVLINK_MSG_ID_GPS_RAW_INT


def frame_of(message: Any, *, v1: bool = False) -> bytes:
    packer = mavlink.MAVLink(None, 1, 1)
    return bytes(message.pack(packer, force_mavlink1=v1))


HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)
FRAMES = [
    frame_of(HEARTBEAT),
    frame_of(HEARTBEAT, v1=True),
    frame_of(mavlink.MAVLink_gps_raw_int_message(0, 3, 1, 2, 3, 4, 5, 6, 7, 8)),
    frame_of(mavlink.MAVLink_sim_state_message(*[1.0] * 21, lat_int=5, lon_int=6)),
]
NOISE = st.binary(max_size=20).map(lambda data: data.replace(b"\xfd", b"").replace(b"\xfe", b""))


# --- frames ---------------------------------------------------------------------------------------------------


@given(st.lists(st.one_of(st.sampled_from(FRAMES), NOISE.filter(bool))), st.data())
def test_a_stream_is_cut_at_frames_wherever_it_was_read(pieces: list[bytes], data: st.DataObject) -> None:
    # GIVEN frames and garbage in one stream, read in arbitrary parts
    stream = b"".join(pieces)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    splitter, chunks = FrameSplitter(), []
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        chunks += splitter.feed(stream[begin:end])
    # THEN no byte is lost or changed, and every frame is one chunk
    assert b"".join(chunks) + splitter.reset() == stream
    whole = [piece for piece in pieces if piece in FRAMES]
    assert [chunk for chunk in chunks if chunk in FRAMES] == whole


@given(st.binary(max_size=400))
def test_no_bytes_of_a_datagram_are_lost(data: bytes) -> None:
    assert b"".join(split_datagram(data)) == data


@given(st.lists(st.binary(min_size=1, max_size=300)))
def test_packed_datagrams_hold_whole_frames_in_order(frames: list[bytes]) -> None:
    datagrams = packed(frames)
    assert b"".join(datagrams) == b"".join(frames)
    assert all(0 < len(datagram) <= 1400 for datagram in datagrams)


def test_message_ids_of_both_versions() -> None:
    assert [message_id(frame) for frame in FRAMES] == [0, 0, GPS, mavlink.MAVLINK_MSG_ID_SIM_STATE]
    assert message_id(FRAMES[0][:-1]) is None
    assert message_id(b"garbage!!") is None


# --- truth ----------------------------------------------------------------------------------------------------


def hil_state(north_mm: int = 0, **changed: Any) -> Any:
    fields = {"attitude_quaternion": [1.0, 0.0, 0.0, 0.0], "lat": round(FRAME.lat_deg * 1e7), "vx": 100} | changed
    values = dict.fromkeys(mavlink.MAVLink_hil_state_quaternion_message.fieldnames, 0)
    values |= {"lon": round(FRAME.lon_deg * 1e7), "alt": round(FRAME.alt_m * 1e3) + 2000} | fields
    return mavlink.MAVLink_hil_state_quaternion_message(**values)


def test_a_truth_is_dated_between_its_stamped_neighbours() -> None:
    tap = TruthTap(FRAME)
    assert tap.on_stamped(50.0, now_s=10.0) == []
    tap.on_message(hil_state(), now_s=10.005)
    (sample,) = tap.on_stamped(50.02, now_s=10.02)
    # a quarter of the way in arrivals is a quarter of the way in boot time
    assert sample.boot_s == pytest.approx(50.005)
    assert sample.position_m == pytest.approx((0.0, 0.0, -2.0), abs=0.01)
    assert sample.velocity_mps == (1.0, 0.0, 0.0)


def test_a_truth_held_up_by_a_stall_is_not_dated_by_its_arrival() -> None:
    tap = TruthTap(FRAME)
    tap.on_stamped(50.0, now_s=10.0)
    # GIVEN a host that stalls for 0.3 s, so that two periods arrive in one burst
    tap.on_message(hil_state(), now_s=10.3)
    (first,) = tap.on_stamped(50.02, now_s=10.3)
    tap.on_message(hil_state(), now_s=10.3)
    (second,) = tap.on_stamped(50.04, now_s=10.3)
    assert 50.0 <= first.boot_s <= 50.02 <= second.boot_s <= 50.04


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"attitude_quaternion": [math.nan, 0.0, 0.0, 0.0]}, "no unit quaternion"),
        ({"lat": 0, "lon": 0}, "no position"),
        ({"lat": 1_000_000_000}, "no position"),
    ],
)
def test_a_truth_that_is_none_is_counted(changed: dict[str, Any], reason: str) -> None:
    tap = TruthTap(FRAME)
    tap.on_stamped(50.0, 10.0)
    tap.on_message(hil_state(**changed), 10.0)
    assert tap.on_stamped(50.02, 10.02) == []
    assert tap.ignored == {reason: 1}


def sim_state(lat_int: int, lon_int: int, velocity: float = 1.0) -> Any:
    values = dict.fromkeys(mavlink.MAVLink_sim_state_message.fieldnames, 0.0)
    values |= {"alt": FRAME.alt_m + 3.0, "vn": velocity, "lat_int": lat_int, "lon_int": lon_int}
    return mavlink.MAVLink_sim_state_message(**values)


def test_old_ardupilots_have_their_exact_place_in_simstate() -> None:
    tap = TruthTap(FRAME)
    tap.on_stamped(50.0, 10.0)
    tap.on_message(sim_state(0, 0), 10.0)
    assert tap.needs_simstate
    tap.on_message(
        mavlink.MAVLink_simstate_message(*[0.0] * 9, round(1e7 * FRAME.lat_deg), round(1e7 * FRAME.lon_deg)), 10.01
    )
    (sample,) = tap.on_stamped(50.02, 10.02)
    assert sample.position_m == pytest.approx((0.0, 0.0, -3.0), abs=0.01)
    assert sample.velocity_mps == (1.0, 0.0, 0.0)


def test_a_velocity_that_is_not_finite_is_no_truth() -> None:
    tap = TruthTap(FRAME)
    tap.on_stamped(50.0, 10.0)
    tap.on_message(sim_state(1, 1, velocity=math.nan), 10.0)
    assert tap.on_stamped(50.02, 10.02) == []
    assert tap.ignored == {"not finite": 1}


# --- session against the strict autopilots, in virtual time ------------------------------------------------------


def converse(agent: int, seconds: float, **tables: Any) -> tuple[SitlSession, Simulation, list[TimedTruth]]:
    """A session and its autopilot without sockets."""
    config = fleet_config(ids=(agent,), **tables)
    scenario = grounded_fleet((agent,))
    simulation = Simulation(scenario, 1000.0)
    session, truths, now = SitlSession(config, agent, datagrams=False), [], 1000.0
    while now < 1000.0 + seconds:
        now = simulation.next_step_s()
        up = b"".join(frame for _, frame in simulation.advance(now).frames)
        truths += session.receive(up, now)
        for frame in session.to_send(now):
            truths += session.receive(b"".join(simulation.receive(agent, frame, now)), now)
    return session, simulation, truths


@pytest.mark.parametrize("agent", [1, 2])
def test_it_asks_each_autopilot_for_the_message_that_it_has(agent: int) -> None:
    session, _, truths = converse(agent, 4.0)
    assert session.flavour == {1: "px4", 2: "ardupilot"}[agent]
    assert session.refusal is None
    assert len(truths) == pytest.approx(50 * 4.0, rel=0.05)
    times = np.array([truth.host_s for truth in truths])
    assert (np.diff(times) > 0.0).all()
    assert np.diff(times[-100:]) == pytest.approx(np.full(99, 0.02), abs=0.006)
    np.testing.assert_allclose(truths[-1].position_m, {1: (0, 0, 0), 2: (0, 12, 0)}[agent], atol=0.02)


@pytest.mark.parametrize(("agent", "parameter", "there"), [(1, "SIM_GPS_USED", 10.0), (2, "SIM_GPS1_ENABLE", 1.0)])
def test_it_takes_gps_away_and_puts_back_what_was_there(agent: int, parameter: str, there: float) -> None:
    outages = [{"agent": agent, "from_s": 1.0, "to_s": 2.0}]
    session, simulation, _ = converse(agent, 3.0, sitl={"autopilot_gps": outages})
    autopilot = simulation.autopilots[agent]

    def told(off: bool) -> float:
        session.gps_off = off
        for _ in range(400):
            now = simulation.next_step_s()
            session.receive(b"".join(frame for _, frame in simulation.advance(now).frames), now)
            for frame in session.to_send(now):
                session.receive(b"".join(simulation.receive(agent, frame, now)), now)
        assert session.receiver is not None
        assert session.receiver.is_off is off
        return autopilot.state.parameters.value(parameter)

    assert autopilot.state.parameters.value(parameter) == there
    assert told(True) == 0.0
    assert not autopilot.state.navigation.aided(simulation.now)
    assert told(False) == there
    assert autopilot.state.navigation.aided(simulation.now)


def test_it_leaves_parameters_alone_that_nobody_spoke_of() -> None:
    session, simulation, _ = converse(1, 3.0)

    assert session.receiver is None
    assert simulation.autopilots[1].counters.ignored["unknown parameter"] == 0


def test_answers_to_the_daemon_are_not_taken_for_answers_to_the_bridge() -> None:
    config = fleet_config(ids=(2,))
    session = SitlSession(config, 2, datagrams=True)
    ardupilot = mavlink.MAVLink(None, 2, 1)
    session.receive(bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(ardupilot)), 10.0)
    assert session.to_send(10.0)
    denied = mavlink.MAVLink_command_ack_message(511, 2, target_system=2, target_component=197)
    session.receive(bytes(denied.pack(ardupilot)), 10.1)
    assert session.refusal is None
    denied.target_component = COMPONENT_ID
    session.receive(bytes(denied.pack(ardupilot)), 10.2)
    assert "refuses SIM_STATE" in str(session.refusal)


def test_another_vehicle_on_the_link_is_named() -> None:
    session = SitlSession(fleet_config(ids=(2,)), 2, datagrams=True)
    for system, autopilot in ((7, 3), (2, 12)):
        packer = mavlink.MAVLink(None, system, 1)
        session.receive(bytes(mavlink.MAVLink_heartbeat_message(2, autopilot, 0, 0, 4, 3).pack(packer)), 10.0)
    assert session.flavour is None
    assert set(session.ignored) == {"system id 7", "autopilot px4 instead of ardupilot"}
    assert session.to_send(10.0) == []


def test_the_two_flavours_refuse_the_others_truth() -> None:
    for agent, foreign in ((1, mavlink.MAVLINK_MSG_ID_SIM_STATE), (2, mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION)):
        simulation = Simulation(grounded_fleet((agent,)), 1000.0)
        request = mavlink.MAVLink_command_long_message(agent, 1, 511, 0, float(foreign), 20000.0, 0, 0, 0, 0, 0)
        (frame,) = simulation.receive(agent, bytes(request.pack(mavlink.MAVLink(None, 245, 190))), 1000.0)
        (ack,) = mavlink.MAVLink(None).parse_buffer(frame)
        assert ack.result == {1: mavlink.MAV_RESULT_FAILED, 2: mavlink.MAV_RESULT_DENIED}[agent]


# --- addresses, missions, options ---------------------------------------------------------------------------------


def test_default_addresses_are_those_of_the_simulators() -> None:
    links = vehicle_links(fleet_config())
    assert [str(link.simulator) for link in links.values()] == [
        "udpin:127.0.0.1:14540", "tcpout:127.0.0.1:5770", "udpin:127.0.0.1:14542"
    ]  # fmt: skip
    assert [link.client_port for link in links.values()] == [14590, 14591, 14592]


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"sitl": {"vehicles": [{"agent": 9, "simulator": "tcp:127.0.0.1:1"}]}}, "ids of agents"),
        ({"sitl": {"vehicles": [{"agent": 1, "simulator": "tcp:127.0.0.1:1"}] * 2}}, "one entry per agent"),
        ({"sitl": {"vehicles": [{"agent": 1, "simulator": "nonsense"}]}}, "sitl.vehicles of agent 1, simulator"),
        ({"sitl": {"vehicles": [{"agent": 1, "simulator": "tcp:127.0.0.1:14651"}]}}, "an address of its own"),
        ({"mavlink": {"component_id": 194}}, "another id than the bridge"),
        ({"agents": [{"id": 1, "mavlink": "udpin:127.0.0.1:14651"}]}, "autopilot px4 or ardupilot"),
        ({"agents": [{"id": 1, "autopilot": "px4", "mavlink": "tcp:127.0.0.1:5760"}]}, "udpin:HOST:PORT or udpout"),
        (
            {
                "fleet": {
                    "name": "x",
                    "origin": {"lat_deg": 1.0, "lon_deg": 1.0, "alt_m": 1.0, "altitude": "ellipsoid"},
                }
            },
            "geoid separation",
        ),
        ({"sim": {"faults": [{"kind": "gps_off", "agents": [1]}]}}, "sim.faults, entry 1, kind: expected uwb_wrong"),
    ],
)
def test_addresses_that_cannot_work_are_named(tables: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        vehicle_links(fleet_config(**tables))


MISSION = "[[drones]]\nagent = 1\nwaypoints_m = [[1.0, 2.0, -8.0]]\n"


def test_a_mission_is_read(tmp_path: Path) -> None:
    file = tmp_path / "mission.toml"
    file.write_text("takeoff_m = 5.0\n" + MISSION)
    mission = load_mission(file, fleet_config())
    assert (mission.takeoff_m, mission.drones[0].waypoints_m) == (5.0, ((1.0, 2.0, -8.0),))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("takeoff_m = -1.0\n" + MISSION, "takeoff_m"),
        (MISSION + MISSION, "one entry per drone"),
        (MISSION.replace("1\n", "7\n", 1), "one of 1, 2, 3, found 7"),
        (MISSION.replace("2.0", "nan"), "finite"),
        (MISSION + "hold_s = 100.0\n", "less than leg_timeout_s"),
        ("", "drones"),
        ("takeoff_m = ", "valid TOML"),
    ],
)
def test_a_wrong_mission_is_refused(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "mission.toml"
    file.write_text(text)
    with pytest.raises(MissionError, match=words):
        load_mission(file, fleet_config())
    with pytest.raises(MissionError, match="readable"):
        load_mission(tmp_path / "none.toml", fleet_config())


def test_gps_drops_become_outages() -> None:
    assert gps_outage("2:10,20", (1, 2), None).to_s == 20.0
    last = gps_outage("2:-30,", (1, 2), 100.0)
    assert (last.from_s, last.to_s) == (70.0, 1e9)
    assert gps_outage("1", (1, 2), None).from_s == 0.0
    for text, duration_s, error in (
        ("3", None, InputError), ("2:-30,", None, InputError), ("2:20,10", None, InputError), ("x", None, ReplayError)
    ):  # fmt: skip
        with pytest.raises(error):
            gps_outage(text, (1, 2), duration_s)


def test_the_option_is_named_that_is_wrong() -> None:
    with pytest.raises(InputError, match="--autopilot-gps: expected one of the ids 1, 2, found 3"):
        gps_outage("3:1,2", (1, 2), None, "--autopilot-gps")
    with pytest.raises(ConfigError, match="autopilot_gps"):
        sitl_table(fleet_config(sitl={"autopilot_gps": [{"agent": 1, "from_s": 3.0, "to_s": 2.0}]}))


def test_the_frame_is_that_of_the_fleet() -> None:
    assert FleetFrame.of(fleet_config()).ned(FRAME.lat_deg, FRAME.lon_deg, FRAME.alt_m) == pytest.approx((0, 0, 0))

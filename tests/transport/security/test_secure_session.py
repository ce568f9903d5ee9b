"""Mutual TLS and access control between real sessions on loopback, with certificates made for the test."""

from __future__ import annotations

import asyncio
import shutil
import socket
import subprocess
from pathlib import Path

import pytest
import zenoh

from tests.support.ports import free_port
from transport.link.session import Handlers, Session, open_session
from transport.link.session_settings import SessionSettings, TlsSettings, zenoh_config
from transport.link.streams import Stream, key_expression

FLEET, BOUND_S = "secure", 15.0
MEMBERS = (1, 2, 3)
CURVE = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"]

pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl to make certificates")


def openssl(directory: Path, *arguments: str) -> None:
    subprocess.run(["openssl", *arguments], cwd=directory, check=True, capture_output=True, timeout=60)


def make_authority(directory: Path, name: str) -> None:
    openssl(
        directory, "req", "-x509", *CURVE, "-keyout", f"{name}.key", "-out", f"{name}.pem", "-days", "2",
        "-subj", f"/CN={name}", "-addext", "keyUsage=critical,keyCertSign,cRLSign",
    )  # fmt: skip


def make_member(directory: Path, authority: str, agent_id: int, file: str) -> TlsSettings:
    (directory / "leaf.cnf").write_text(
        "basicConstraints=critical,CA:FALSE\nsubjectAltName=IP:127.0.0.1,DNS:localhost\n"
        "extendedKeyUsage=serverAuth,clientAuth\n"
    )
    subject = f"/CN={FLEET}.agent.{agent_id:03d}"
    openssl(directory, "req", "-new", *CURVE, "-keyout", f"{file}.key", "-out", "csr", "-subj", subject)
    openssl(
        directory, "x509", "-req", "-in", "csr", "-CA", f"{authority}.pem", "-CAkey", f"{authority}.key",
        "-CAcreateserial", "-days", "2", "-extfile", "leaf.cnf", "-out", f"{file}.pem",
    )  # fmt: skip
    paths = [str(directory / name) for name in ("fleet.pem", f"{file}.pem", f"{file}.key")]
    return TlsSettings(*paths)


async def test_members_put_on_their_own_keys_only_and_strangers_stay_out(tmp_path: Path) -> None:
    # GIVEN a fleet with an authority, agent 1 that listens, and another authority nobody knows
    for authority in ("fleet", "rogue"):
        make_authority(tmp_path, authority)
    tls = {agent_id: make_member(tmp_path, "fleet", agent_id, f"a{agent_id}") for agent_id in (1, 2)}
    stranger_tls = make_member(tmp_path, "rogue", 3, "rogue3")
    endpoint = f"tls/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    samples: asyncio.Queue[tuple[str, bytes]] = asyncio.Queue()
    sessions: list[Session] = []
    here = asyncio.Event()

    async def open_as(agent_id: int, settings: SessionSettings, handlers: Handlers) -> Session:
        session = await open_session(settings, FLEET, agent_id, MEMBERS, handlers)
        sessions.append(session)
        return session

    try:
        one = await open_as(
            1,
            SessionSettings(listen=(endpoint,), tls=tls[1]),
            Handlers(lambda key, payload, _: samples.put_nowait((key, payload))),
        )
        for agent_id in (2, 3):
            one.subscribe(agent_id, [Stream.MEAS])
        one.announce()
        stranger = await open_as(3, SessionSettings(connect=(endpoint,), tls=stranger_tls), Handlers(print))
        stranger.announce()
        # and agent 2, a member with a good certificate that does not keep to the rules itself
        config = zenoh_config(SessionSettings(connect=(endpoint,), tls=tls[2]), FLEET, 2, MEMBERS)
        config.insert_json5("access_control", '{"enabled": false}')
        handlers = Handlers(print, lambda *_: here.set())
        two = Session(await asyncio.to_thread(zenoh.open, config), FLEET, 2, handlers, 100)
        sessions.append(two)
        two.announce()
        await asyncio.wait_for(here.wait(), BOUND_S)
        # WHEN agent 2 speaks first as agent 3 and then as itself
        two.publish(Stream.MEAS, b"as agent 3", agent_id=3)
        two.publish(Stream.MEAS, b"as agent 2")
        # THEN only the second is heard, and the stranger has no link at all
        heard = await asyncio.wait_for(samples.get(), BOUND_S)
        assert heard == (key_expression(FLEET, 2, Stream.MEAS), b"as agent 2")
        assert samples.empty()
        assert (one.connected(), two.connected(), stranger.connected()) == (1, 1, 0)
    finally:
        for session in reversed(sessions):
            await session.close()

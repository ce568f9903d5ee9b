"""What a security profile promises, whether all of it is there, and the credentials that go with it.

===========  ===========  ===================  =============  ==============  ====================================
profile      links        packets              payloads       UWB frames      MAVLink (``mavlink.signing = "auto"``)
===========  ===========  ===================  =============  ==============  ====================================
lab          plain        signed, or unsigned  as asked for   as they come    unsigned
field        mutual TLS,  signed               as asked for   with the        signed on all links but serial ones
             access                            (TLS already)  drone's
             control                                          certificate
lossy_field  plain        signed               as asked for   sealed          signed on all links but serial ones
===========  ===========  ===================  =============  ==============  ====================================

The checks read key files and nothing else: no socket, no clock. ``base`` is the folder of the configuration file,
``unix_s`` the wall clock.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from agent.config.endpoints import Endpoint, LinkKind, parse_endpoint
from agent.config.tables import FleetConfig
from agent.errors import SecurityError
from agent.mavlink.signing import LinkSigning
from agent.mavlink.signing_stamps import StampFile
from transport.errors import KeyFileError, UnwritableError
from transport.link.addresses import SECURE_LINKS
from transport.link.session_settings import SessionSettings, TlsSettings
from transport.security.auth import UNSIGNED, Signing, Trust
from transport.security.certificate_files import Member, authority_key_path, authority_path
from transport.security.envelope import SALT_BYTES, Envelopes
from transport.security.keys import load_public_keys, load_secret, load_trust, next_boot, secret_path
from transport.security.shared_keys import load_group_keys, load_mavlink_key
from transport.security.uwb_seal import UwbSeal

WARN_BEFORE_S = 14 * 86_400.0
"""Certificates that expire within this are warned of."""
HOST_START = Path("/proc/sys/kernel/random/boot_id")
"""Linux's name for the time since the computer was started."""


@dataclass(frozen=True, slots=True)
class Credentials:
    """What an agent goes on the air with.

    ``envelopes`` is ``None`` where nothing is encrypted, ``uwb_seal`` where UWB frames are taken as they come.
    """

    signing: Signing
    trust: Trust
    boot: int
    envelopes: Envelopes | None
    uwb_seal: UwbSeal | None = None


def key_folder(config: FleetConfig, base: Path) -> Path:
    """The folder of the fleet's keys."""
    return base / config.security.keys


def state_folder(config: FleetConfig, base: Path) -> Path:
    """Where a daemon keeps what must outlive a restart."""
    security = config.security
    return base / (security.keys if security.state is None else security.state)


def ready_state_folder(config: FleetConfig, base: Path) -> None:
    """Make the folder of ``security.state`` (mode 0700) where only itself is missing.

    Raises `KeyFileError`, `UnwritableError` if the disk refuses.
    """
    folder = state_folder(config, base)
    if config.security.state is None or os.path.isdir(folder):
        return
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
    except FileNotFoundError:
        raise KeyFileError(f"security.state: {folder.parent}, in which it would be made, is not there") from None
    except OSError as error:
        raise UnwritableError(f"security.state: {folder} cannot be made: {error.strerror}") from None


def state_warnings(config: FleetConfig, base: Path) -> list[str]:
    """A line if ``security.state`` is a folder that `ready_state_folder` could not make on this machine."""
    folder = state_folder(config, base)
    if config.security.state is None or os.path.isdir(folder) or os.path.isdir(folder.parent):
        return []
    return [f"security.state: neither {folder} nor the folder it would be made in is on this machine"]


def is_field(config: FleetConfig) -> bool:
    """Whether the profile is one of those that promise something."""
    return config.security.profile != "lab"


# --- checks -------------------------------------------------------------------------------------------------


def security_faults(config: FleetConfig, agent_id: int, base: Path, *, unix_s: float) -> list[str]:
    """What an agent's profile promises and does not have: a line each, with what, where and the remedy."""
    faults = _setting_faults(config) + _endpoint_faults(config, agent_id) + _mavlink_faults(config, agent_id, base)
    folder = key_folder(config, base)
    if needs_keys(config, agent_id) and not os.path.isdir(folder):
        return [*_setting_faults(config), *_endpoint_faults(config, agent_id), _no_folder(folder)]
    if config.security.mode == "signed":
        faults += _problems(lambda: load_secret(folder, agent_id))
        for other in sorted(config.ids):
            faults += _problems(lambda other=other: load_public_keys(folder, other))  # type: ignore[misc]
    if config.security.profile == "field":
        faults += _certificate_faults(config, agent_id, folder, unix_s)
    if config.security.encrypt:
        faults += _problems(lambda: load_group_keys(folder))
    return list(dict.fromkeys(faults))


def observer_faults(config: FleetConfig, base: Path, *, unix_s: float) -> list[str]:
    """What someone who only listens is missing."""
    folder = key_folder(config, base)
    faults = _setting_faults(config)
    if config.security.mode == "signed":
        for other in sorted(config.ids):
            faults += _problems(lambda other=other: load_public_keys(folder, other))  # type: ignore[misc]
    if config.security.profile == "field":
        faults += _certificate_faults(config, None, folder, unix_s)
    if config.security.encrypt:
        faults += _problems(lambda: load_group_keys(folder))
    return list(dict.fromkeys(faults))


def needs_keys(config: FleetConfig, agent_id: int) -> bool:
    """Whether an agent needs any key at all."""
    security = config.security
    return security.mode == "signed" or security.encrypt or is_field(config) or signs_mavlink(config, agent_id)


def _no_folder(folder: Path) -> str:
    return f"{folder}: no such key directory; make one with `fleetloc keys init`"


def require(config: FleetConfig, agent_id: int, base: Path, *, unix_s: float) -> None:
    """Raises `SecurityError` if an agent lacks anything that its profile promises."""
    _raise(config, security_faults(config, agent_id, base, unix_s=unix_s))


def agents_here(config: FleetConfig, base: Path) -> tuple[int, ...]:
    """Whose keys this machine should have: everybody's on the ground (or with none at all), else those it has."""
    folder = key_folder(config, base)
    if os.path.exists(authority_key_path(folder)):
        return config.ids
    own = tuple(agent_id for agent_id in config.ids if os.path.exists(secret_path(folder, agent_id)))
    return own or config.ids


def expiry_warnings(config: FleetConfig, member_id: int | None, base: Path, *, unix_s: float) -> list[str]:
    """A line for each certificate in use that expires soon; nothing where TLS is not used."""
    if config.security.profile != "field":
        return []
    from transport.security.certificates import (  # takes 11 MB that other profiles need not
        date,
        info_of,
        read_certificate,
    )

    folder = key_folder(config, base)
    warnings = []
    for path in (authority_path(folder), Member(config.fleet.name, member_id).certificate(folder)):
        until_s = info_of(read_certificate(path)).until_unix_s
        if until_s - unix_s < WARN_BEFORE_S:
            warnings.append(f"{path}: expires on {date(until_s)}; `fleetloc keys rotate` makes a new one")
    return warnings


def listening_hosts(config: FleetConfig, agent_id: int) -> set[str]:
    """The addresses and names that an agent's certificate has to name."""
    return {_host(endpoint) for endpoint in config.listen(agent_id)} - {"", "0.0.0.0", "::"}


def _certificate_faults(config: FleetConfig, agent_id: int | None, folder: Path, unix_s: float) -> list[str]:
    from transport.security.certificates import certificate_faults  # as above

    hosts = set() if agent_id is None else listening_hosts(config, agent_id)
    return certificate_faults(folder, Member(config.fleet.name, agent_id), hosts, unix_s=unix_s)


def _raise(config: FleetConfig, faults: Iterable[str]) -> None:
    faults = tuple(faults)
    if faults:
        raise SecurityError(config.security.profile, faults)


def _problems(load: Callable[[], object]) -> list[str]:
    try:
        load()
    except KeyFileError as error:
        return [str(error)]
    return []


def _setting_faults(config: FleetConfig) -> list[str]:
    security = config.security
    faults = []
    if is_field(config) and security.mode != "signed":
        faults.append(f'security.mode: expected "signed" in profile {security.profile}, found "{security.mode}"')
    if security.encrypt and security.mode != "signed":
        faults.append('security.encrypt: expected security.mode = "signed" with it, found "unsigned"')
    return faults


def _endpoint_faults(config: FleetConfig, agent_id: int) -> list[str]:
    """Endpoints that the profile cannot protect."""
    profile, faults = config.security.profile, []
    if profile == "lab":
        return []
    for name, endpoints in (("listen", config.listen(agent_id)), ("connect", config.connect(agent_id))):
        for endpoint in endpoints:
            where = f"agents.{agent_id}.{name}: {endpoint!r}"
            secure = endpoint.partition("/")[0] in SECURE_LINKS
            if profile == "field" and not secure:
                faults.append(f"{where}: expected tls/HOST:PORT in profile field; lossy_field is the one without TLS")
            if profile == "lossy_field" and secure:
                faults.append(f"{where}: expected tcp/ or udp/ in profile lossy_field; field is the one with TLS")
    return faults


def _host(endpoint: str) -> str:
    """Host of a Zenoh endpoint such as ``tls/192.168.7.3:7447#iface=wlan0``."""
    address = endpoint.partition("/")[2].partition("?")[0].partition("#")[0]
    return address.rpartition(":")[0].strip("[]")


# --- MAVLink ------------------------------------------------------------------------------------------------


def signs_mavlink(config: FleetConfig, agent_id: int) -> bool:
    """Whether an agent's MAVLink link is signed."""
    wanted = config.mavlink.signing
    if wanted == "auto":
        return is_field(config) and parse_endpoint(config.agent(agent_id).mavlink).kind is not LinkKind.SERIAL
    return wanted == "on"


def mavlink_signing(config: FleetConfig, agent_id: int, base: Path, *, unix_s: float) -> LinkSigning | None:
    """The signing of an agent's MAVLink link with the stamps of earlier starts, ``None`` where it is unsigned.

    Raises `KeyFileError`.
    """
    if not signs_mavlink(config, agent_id):
        return None
    key = load_mavlink_key(key_folder(config, base), agent_id)
    ready_state_folder(config, base)
    return LinkSigning(key, unix_s=unix_s, stamps=stamp_file(config, agent_id, base).load())


def stamp_file(config: FleetConfig, agent_id: int, base: Path) -> StampFile:
    """Where the stamps of an agent's MAVLink link are kept."""
    return StampFile(state_folder(config, base) / f"agent_{agent_id:03d}.stamps")


def seen_file(config: FleetConfig, agent_id: int, base: Path) -> Path | None:
    """Where it is kept which packets an agent has seen; ``None`` in fleets that do not sign."""
    if config.security.mode != "signed":
        return None
    return state_folder(config, base) / f"agent_{agent_id:03d}.seen"


def simulated_mavlink_keys(config: FleetConfig, base: Path) -> dict[int, bytes]:
    """The keys that simulated autopilots sign with, by agent; none for unsigned links. Raises `KeyFileError`."""
    folder = key_folder(config, base)
    return {agent: load_mavlink_key(folder, agent) for agent in config.ids if signs_mavlink(config, agent)}


def _mavlink_faults(config: FleetConfig, agent_id: int, base: Path) -> list[str]:
    if signs_mavlink(config, agent_id):
        return _problems(lambda: load_mavlink_key(key_folder(config, base), agent_id))
    endpoint = parse_endpoint(config.agent(agent_id).mavlink)
    if not is_field(config) or endpoint.kind is LinkKind.SERIAL or _on_loopback(endpoint):
        return []
    return [
        f'mavlink.signing: expected "auto" or "on" in profile {config.security.profile} for the link '
        f'{endpoint} of agent {agent_id}, which leaves the machine, found "off"'
    ]


def _on_loopback(endpoint: Endpoint) -> bool:
    try:
        return ipaddress.ip_address(endpoint.host).is_loopback
    except ValueError:
        return endpoint.host == "localhost"


# --- credentials --------------------------------------------------------------------------------------------


def credentials(config: FleetConfig, agent_id: int, base: Path, *, unix_s: float, salt: bytes) -> Credentials:
    """What an agent goes on the air with, its next start number taken; ``salt`` is random, `SALT_BYTES` long.

    Raises `SecurityError` if anything that the profile promises is missing, `KeyFileError`.
    """
    require(config, agent_id, base, unix_s=unix_s)
    if config.security.mode == "unsigned":
        return Credentials(UNSIGNED, UNSIGNED, int(unix_s), None)
    folder = key_folder(config, base)
    ready_state_folder(config, base)
    boot = next_boot(state_folder(config, base) / f"agent_{agent_id:03d}.boot", unix_s)
    envelopes = None
    if config.security.encrypt:
        envelopes = Envelopes(load_group_keys(folder), agent_id, boot=boot, salt=salt)
    secret = load_secret(folder, agent_id)
    seal = UwbSeal(secret, host_start()) if seals_uwb(config) else None
    return Credentials(secret, load_trust(folder, config.ids), boot, envelopes, seal)


def seals_uwb(config: FleetConfig) -> bool:
    """Whether UWB frames have to be sealed by the drone's own driver: in a field profile whose links are plain."""
    return config.security.profile == "lossy_field"


def new_salt() -> bytes:
    """A salt for `credentials`, from the system's generator."""
    return os.urandom(SALT_BYTES)


def observer_credentials(config: FleetConfig, base: Path, *, unix_s: float) -> tuple[Trust, Envelopes | None]:
    """What someone who only listens checks and opens packets with; raises `SecurityError`."""
    _raise(config, observer_faults(config, base, unix_s=unix_s))
    folder = key_folder(config, base)
    trust: Trust = UNSIGNED if config.security.mode == "unsigned" else load_trust(folder, config.ids)
    return trust, Envelopes(load_group_keys(folder), None) if config.security.encrypt else None


def tls_settings(config: FleetConfig, agent_id: int | None, base: Path) -> TlsSettings | None:
    """The certificate files of an agent, or without id of an observer; ``None`` where the profile has no TLS."""
    if config.security.profile != "field":
        return None
    folder, member = key_folder(config, base).resolve(), Member(config.fleet.name, agent_id)
    files = authority_path(folder), member.certificate(folder), member.private_key(folder)
    return TlsSettings(*map(str, files))


def agent_session(config: FleetConfig, agent_id: int, base: Path) -> SessionSettings:
    """The session of an agent with its neighbours."""
    tls = tls_settings(config, agent_id, base)
    transport = config.transport
    return SessionSettings(
        listen=config.listen(agent_id),
        connect=config.connect(agent_id),
        tls=tls,
        lease_ms=round(1e3 * transport.lease_s),
        open_timeout_ms=round(1e3 * transport.open_timeout_s),
        retry_max_ms=round(1e3 * transport.retry_max_s),
    )


def observer_session(config: FleetConfig, base: Path) -> SessionSettings:
    """The session of someone who only listens: dials every agent."""
    endpoints = (endpoint for agent_id in config.ids for endpoint in config.device_endpoints(agent_id))
    return SessionSettings(connect=tuple(dict.fromkeys(endpoints)), tls=tls_settings(config, None, base))


def host_start() -> bytes:
    """What tells this start of the computer from others, the same in all its containers; empty where nothing does."""
    try:
        return HOST_START.read_bytes().strip()
    except OSError:
        return b""


def driver_session(config: FleetConfig, agent_id: int, base: Path) -> SessionSettings:
    """The session of a UWB driver beside an agent, under whose id it is to be opened: dials that agent.

    Raises `KeyFileError` where frames have to be sealed and the agent's signing key cannot be read.
    """
    seal = UwbSeal(load_secret(key_folder(config, base), agent_id), host_start()) if seals_uwb(config) else None
    tls = tls_settings(config, agent_id, base)
    return SessionSettings(connect=config.device_endpoints(agent_id), tls=tls, uwb_seal=seal)

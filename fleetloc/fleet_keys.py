"""All keys of a fleet in one folder: made, shown, replaced, and handed out drone by drone."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from agent.config.tables import FleetConfig
from agent.radio.security import key_folder, listening_hosts
from fleetloc.errors import InputError
from transport.errors import KeyFileError
from transport.security.certificate_files import Member, authority_key_path, authority_path
from transport.security.certificates import LEAF_DAYS, date, info_of, issue, make_authority, read_certificate
from transport.security.keys import add_key, init_keys, list_keys, public_path, retire_key, rotate_key, secret_path
from transport.security.shared_keys import (
    group_path,
    key_fingerprint,
    load_group_keys,
    load_mavlink_key,
    make_group_key,
    make_mavlink_key,
    mavlink_path,
    replace_mavlink_key,
    retire_group_key,
    rotate_group_key,
)

SOON_S = 14 * 86_400.0


@dataclass(frozen=True, slots=True)
class FleetKeys:
    """The key folder of a fleet's configuration; ``base`` is the folder of the configuration file."""

    config: FleetConfig
    base: Path
    unix_s: float
    days: float = LEAF_DAYS

    @property
    def folder(self) -> Path:
        """Where the keys are."""
        return key_folder(self.config, self.base)

    # --- making ---------------------------------------------------------------------------------------------

    def init(self, *, missing_only: bool) -> None:
        """Make everything for every agent; with ``missing_only`` what is not there, else nothing may be there.

        Raises `KeyFileError`; nothing that exists is overwritten.
        """
        init_keys(self.folder, [i for i in self.config.ids if not (missing_only and self._has_signing(i))])
        if not (missing_only and os.path.exists(authority_path(self.folder))):
            make_authority(self.folder, self.config.fleet.name, unix_s=self.unix_s)
        if not (missing_only and os.path.exists(group_path(self.folder))):
            make_group_key(self.folder)
        for member in (*self.config.ids, None):
            if not (missing_only and os.path.exists(self._member(member).certificate(self.folder))):
                self.certify(member)
        for agent_id in self.config.ids:
            if not (missing_only and os.path.exists(mavlink_path(self.folder, agent_id))):
                make_mavlink_key(self.folder, agent_id)

    def add(self, agent_id: int) -> None:
        """Make everything for one more agent."""
        add_key(self.folder, agent_id)
        self.certify(agent_id)
        make_mavlink_key(self.folder, agent_id)

    def certify(self, member_id: int | None) -> None:
        """Issue a new certificate to an agent, or without id to the observer."""
        hosts = set() if member_id is None else listening_hosts(self.config, member_id)
        issue(self.folder, self._member(member_id), hosts, unix_s=self.unix_s, days=self.days)

    # --- replacing ------------------------------------------------------------------------------------------

    def rotate(self, agent_id: int) -> None:
        """A new signing key and, where the authority is here, a new certificate."""
        rotate_key(self.folder, agent_id)
        if os.path.exists(authority_key_path(self.folder)):
            self.certify(agent_id)

    def retire(self, agent_id: int) -> None:
        """Stop accepting the signing key from before an agent's last rotation."""
        retire_key(self.folder, agent_id)

    def rotate_group(self) -> None:
        """A new group key; the present one is accepted until it is retired."""
        rotate_group_key(self.folder)

    def retire_group(self) -> None:
        """Stop accepting the group key from before the last rotation."""
        retire_group_key(self.folder)

    def rotate_mavlink(self, agent_id: int) -> None:
        """A new key for an agent's MAVLink link."""
        replace_mavlink_key(self.folder, agent_id)

    # --- showing --------------------------------------------------------------------------------------------

    def lines(self) -> Iterator[str]:
        """A line for each agent and each thing that the fleet shares; raises `KeyFileError`."""
        for info in list_keys(self.folder):
            secret = "secret here" if info.has_secret else "public only"
            parts = [f"agent {info.agent_id:3d}  {secret}  {_named(info.fingerprints)}"]
            parts.append(self._validity("certificate", self._member(info.agent_id).certificate(self.folder)))
            if os.path.exists(mavlink_path(self.folder, info.agent_id)):
                key = load_mavlink_key(self.folder, info.agent_id)
                parts.append(f"mavlink {key_fingerprint(key)}")
            yield "  ".join(part for part in parts if part)
        yield from filter(None, (self._validity("authority", authority_path(self.folder)),))
        yield from filter(None, (self._validity("observer", self._member(None).certificate(self.folder)),))
        if os.path.exists(group_path(self.folder)):
            yield f"group  {_named([key_fingerprint(key) for key in load_group_keys(self.folder)])}"

    def _validity(self, name: str, path: Path) -> str:
        if not os.path.exists(path):
            return ""
        info = info_of(read_certificate(path))
        left_s = info.until_unix_s - self.unix_s
        state = "EXPIRED on" if left_s <= 0 else ("expires soon, on" if left_s < SOON_S else "valid until")
        return f"{name} {state} {date(info.until_unix_s)}"

    # --- handing out ----------------------------------------------------------------------------------------

    def export(self, member_id: int | None, out: Path) -> list[Path]:
        """Copy what one drone (or without id an observer) needs, and nothing else, into a new folder.

        The authority's key and other drones' secrets stay here. Raises `KeyFileError`, `InputError`.
        """
        member, folder = self._member(member_id), self.folder
        private = [member.private_key(folder), group_path(folder)]
        if member_id is not None:
            private += [secret_path(folder, member_id), mavlink_path(folder, member_id)]
        public = [authority_path(folder), member.certificate(folder)]
        public += [public_path(folder, other) for other in self.config.ids]
        for path in (*private, *public):
            if not os.path.exists(path):
                raise KeyFileError(f"{path}: not there to be exported; see `fleetloc keys init --missing`")
        if out.exists():
            raise InputError("--out", "", "a folder that does not exist yet", str(out))
        out.mkdir(mode=0o700, parents=True)
        for path in (*private, *public):
            shutil.copy(path, out / path.name)  # the mode too
        return sorted(out.iterdir())

    def _member(self, member_id: int | None) -> Member:
        return Member(self.config.fleet.name, member_id)

    def _has_signing(self, agent_id: int) -> bool:
        return os.path.exists(public_path(self.folder, agent_id))


def _named(fingerprints: Sequence[str]) -> str:
    """The key in use, and those before it that are still accepted."""
    newest, *older = fingerprints
    return "  ".join([f"key {newest}", *(f"former key {each} (accepted until it is retired)" for each in older)])

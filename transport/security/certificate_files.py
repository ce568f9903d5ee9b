"""Where certificates and their keys are in a fleet's key folder.

``ca.key`` signs and stays on the ground; ``ca.pem`` is what everybody trusts. A drone has ``agent_001.pem`` with
``agent_001.tls``, its private key; ``observer.pem`` and ``observer.tls`` belong to those who only listen. What is in
them is the business of `transport.security.certificates`, which takes a library of 11 MB that only TLS needs.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from transport.link.streams import agent_name, check_agent_id, observer_name


@dataclass(frozen=True, slots=True)
class Member:
    """Whose certificate: an agent's, or without id the observer's."""

    fleet: str
    agent_id: int | None

    @property
    def common_name(self) -> str:
        """The name that access control goes by."""
        return observer_name(self.fleet) if self.agent_id is None else agent_name(self.fleet, self.agent_id)

    @property
    def stem(self) -> str:
        """Begin of its files' names."""
        return "observer" if self.agent_id is None else f"agent_{check_agent_id(self.agent_id):03d}"

    def certificate(self, directory: Path) -> Path:
        """Where its certificate is."""
        return directory / f"{self.stem}.pem"

    def private_key(self, directory: Path) -> Path:
        """Where the certificate's private key is."""
        return directory / f"{self.stem}.tls"


def authority_path(directory: Path) -> Path:
    """Where the authority's certificate is."""
    return directory / "ca.pem"


def authority_key_path(directory: Path) -> Path:
    """Where the authority's private key is: on the ground only."""
    return directory / "ca.key"

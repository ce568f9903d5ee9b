"""A running daemon under a few thousand hostile packets and datagrams; docs/results.md has the full run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.fleet.fuzz_daemon import fuzz
from tests.fleet.fuzz_traffic import DatagramMaker, PacketMaker

PACKETS, DATAGRAMS, DURATION_S = 4000, 4000, 4.0


def test_every_hostile_datagram_has_to_leave_a_trace() -> None:
    for datagram in DatagramMaker(np.random.default_rng(3)).make(2000):
        assert sum(datagram.counts.values()) >= 1, datagram


@pytest.mark.slow
@pytest.mark.realtime
def test_a_daemon_refuses_and_counts_whatever_a_stranger_sends(tmp_path: Path) -> None:
    # GIVEN a live fleet with signed packets, WHEN a peer without a key fuzzes the one in the middle
    result = fuzz(tmp_path, PACKETS, DATAGRAMS, DURATION_S, seed=7)
    # THEN it is counted to the last one, and neither memory, ticks nor estimates suffer
    assert result["complaints"] == []
    assert (result["packets"]["sent"], result["datagrams"]["sent"]) == (PACKETS, DATAGRAMS)
    assert len(result["packets"]["by_class"]) >= len(PacketMaker.CLASSES) - 2  # two classes are rare
    assert len(result["datagrams"]["by_class"]) == len(DatagramMaker.CLASSES)
    assert {"bad_signature", "unsigned", "duplicate", "replay", "wrong_fleet", "wrong_key", "stale"} <= {
        name.removeprefix("rejected ") for name in result["rejected_by_reason"]
    }

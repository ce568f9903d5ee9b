"""When a receiver counts as off, and until when the autopilot is told."""

from __future__ import annotations

import pytest

from agent.feedback.spoofing import ATTEMPTS, OVER_S, SURE_S, SpoofedReceiver


class Watched:
    """A receiver that is looked at ten times a second, and an autopilot that is told of it."""

    def __init__(self) -> None:
        self.receiver = SpoofedReceiver()
        self.now_s = 0.0
        self.news: list[bool] = []
        self.told = 0

    def go(self, seconds: float, off_m: float | None) -> None:
        for _ in range(round(10 * seconds)):
            self.now_s += 0.1
            if self.receiver.observe(off_m, self.now_s):
                self.news.append(self.receiver.is_off)
            self.told += self.receiver.due(self.now_s)


def test_a_moment_is_no_news_a_second_is() -> None:
    watched = Watched()
    watched.go(5.0, None)
    watched.go(SURE_S - 0.2, 8.0)
    watched.go(1.0, None)
    assert watched.news == []

    watched.go(SURE_S + 0.2, 9.0)
    assert (watched.news, watched.receiver.off_m) == ([True], 9.0)


def test_it_is_taken_back_late() -> None:
    watched = Watched()
    watched.go(3.0, 8.0)
    watched.go(OVER_S - 0.2, None)
    watched.go(0.5, 8.0)
    watched.go(OVER_S - 0.2, None)
    assert watched.news == [True]

    watched.go(1.0, None)
    assert watched.news == [True, False]


def test_each_change_is_told_until_it_is_acknowledged() -> None:
    watched = Watched()
    watched.go(30.0, 8.0)
    assert (watched.told, watched.receiver.left_out) == (ATTEMPTS, False)

    watched = Watched()
    watched.go(SURE_S + 0.2, 8.0)
    watched.receiver.on_ack(True)
    watched.go(10.0, 8.0)
    assert (watched.told, watched.receiver.left_out) == (1, True)
    watched.go(OVER_S + 0.2, None)
    watched.receiver.on_ack(True)
    assert (watched.told, watched.receiver.left_out) == (2, False)


def test_an_autopilot_that_does_not_know_the_command_is_asked_once() -> None:
    watched = Watched()
    watched.go(SURE_S + 0.2, 8.0)
    watched.receiver.on_ack(False)
    watched.go(30.0, 8.0)

    assert (watched.told, watched.receiver.left_out) == (1, False)


@pytest.mark.parametrize("accepted", [True, False])
def test_what_nobody_asked_for_is_no_acknowledgement(accepted: bool) -> None:
    watched = Watched()
    watched.receiver.on_ack(accepted)
    watched.go(SURE_S + 0.2, 8.0)

    assert (watched.told, watched.receiver.left_out) == (1, False)


def test_after_a_reboot_it_is_told_again() -> None:
    watched = Watched()
    watched.go(SURE_S + 0.2, 8.0)
    watched.receiver.on_ack(True)
    watched.receiver.reset()
    watched.go(0.2, 8.0)
    assert not watched.receiver.left_out
    watched.go(2.0, 8.0)

    assert watched.told >= 2

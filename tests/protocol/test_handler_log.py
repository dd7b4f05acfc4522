"""What handlers raise is logged, and no peer can fill a disk with it."""

import logging

import pytest

from a2s.protocol.errors import MalformedMessageError
from a2s.protocol.handler_log import HandlerLog


def test_of_a_key_and_a_kind_of_error_ten_lines_in_a_minute_and_then_how_many_were_left_out(
    caplog: pytest.LogCaptureFixture,
) -> None:
    now_s = [0.0]
    log = HandlerLog(lambda: now_s[0])

    def handle(key: str, error: Exception) -> None:
        with log.of(key):
            raise error

    with caplog.at_level(logging.ERROR):
        for number in range(1000):
            handle("a2s/r/notice", MalformedMessageError(f"junk {number}"))
        handle("a2s/r/status", MalformedMessageError("another key"))
        handle("a2s/r/notice", ValueError("another kind"))
        now_s[0] = 60.0
        handle("a2s/r/notice", MalformedMessageError("later"))
        handle("a2s/r/notice", MalformedMessageError("and later"))
    assert [record.getMessage() for record in caplog.records] == [
        *(f"junk {number}" for number in range(10)),
        "another key",
        "handler failed key=a2s/r/notice",
        "later (990 like it were left out before)",
        "and later",
    ]
    assert [bool(record.exc_info) for record in caplog.records].index(True) == 11

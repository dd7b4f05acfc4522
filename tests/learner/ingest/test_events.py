"""Events that peers cause: as many as a disk can take."""

from a2s.learner.ingest.events import Events


def test_a_peer_that_is_refused_all_the_time_writes_few_lines() -> None:
    """What was left out is told with the next one; other causes have lines of their own."""
    now_s, lines = [0.0], list[tuple[str, dict[str, object]]]()
    events = Events(lambda kind, **details: lines.append((kind, details)), lambda: now_s[0])
    passed = [events("refusal", "malformed", reason=str(i)) for i in range(1000)]
    assert passed == [True] * 10 + [False] * 990
    assert events("refusal", "oversize", reason="large")
    now_s[0] = 60.0
    assert events("refusal", "malformed", reason="again")
    assert events("refusal", "malformed", reason="and again")
    assert [details["reason"] for _, details in lines[:11]] == [*map(str, range(10)), "large"]
    assert [details for _, details in lines[11:]] == [
        {"reason": "again", "left_out": 990},
        {"reason": "and again"},
    ]

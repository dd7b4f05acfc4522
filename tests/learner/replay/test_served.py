"""A replay over the network: what is served is what is there, and the learner comes first."""

import dataclasses
import itertools
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from functools import partial

import numpy as np
import pytest
from replay_oracle import ENV_ID, SPACES, make_segment

from a2s.learner.replay.remote import RemoteReplay, ServedReplay
from a2s.learner.replay.replay import Replay
from a2s.protocol.codec import decode, encode
from a2s.protocol.errors import MalformedMessageError, RefusedError, UnreachableError
from a2s.protocol.fields import Spaces
from a2s.protocol.in_process import Exchange, InProcessBus
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Refusal
from a2s.protocol.replay_messages import COLUMNS, ReplayInfo, ReplayRequest
from a2s.protocol.transport import Bus
from a2s.protocol.zenoh_bus import ZenohBus

KEYS = Keys("r")
REQUEST = ReplayRequest(
    batch_size=64, seed=3, n_step=2, gamma=0.5, prioritised=False, beta=0.4, fields=COLUMNS
)


@pytest.fixture(params=["in_process", "zenoh"])
def buses(request: pytest.FixtureRequest) -> Iterator[tuple[Bus, Bus]]:
    """A learner's bus and somebody else's."""
    with ExitStack() as stack:
        if request.param == "in_process":
            exchange = Exchange()
            yield InProcessBus(exchange), InProcessBus(exchange)
            return
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
        learner = stack.enter_context(closing(ZenohBus.listen(endpoint)))
        yield learner, stack.enter_context(closing(ZenohBus.connect(endpoint, lambda: False)))


@pytest.fixture
def replay() -> Replay:
    """A replay with two episodes of twenty steps."""
    replay = Replay.in_memory(ENV_ID, SPACES, 100)
    for seq in range(2):
        obs = [100.0 * seq + i for i in range(21)]
        replay.insert(make_segment(obs, [1.0] * 20, seq=seq, end="terminated"))
    return replay


@pytest.fixture
def remote(buses: tuple[Bus, Bus], replay: Replay) -> RemoteReplay:
    """The same replay, as somebody else sees it."""
    ServedReplay(buses[0], KEYS, replay, generation=2, share=1.0).open()
    remote = RemoteReplay(buses[1], KEYS)
    for _ in range(100):
        try:
            remote.info()
            break
        except UnreachableError:  # the declaration is on its way
            threading.Event().wait(0.02)
    return remote


@pytest.mark.parametrize("prioritised", [False, True])
def test_what_is_served_is_what_the_same_seed_draws_here(
    remote: RemoteReplay, replay: Replay, prioritised: bool
) -> None:
    """To the bit; another ``end`` in the next answer says why that differs."""
    replay.update_priorities(np.arange(40), np.linspace(0, 1, 40))
    request = dataclasses.replace(REQUEST, prioritised=prioritised)
    served, again = remote.ask(request), remote.ask(request)
    here = replay.sample(64, np.random.default_rng(3), n_step=2, gamma=0.5, prioritised=prioritised)
    assert (served.begin, served.end) == (0, 40)
    assert served.row == again.row == tuple(here.row)
    for name in COLUMNS[:-1]:
        assert np.array_equal(getattr(served, name), getattr(here, name))
    replay.insert(make_segment([7.0, 8.0], [1.0], seq=2))
    assert remote.ask(request).end == 41


def test_it_is_sampled_like_a_replay_that_is_here(
    remote: RemoteReplay, rng: np.random.Generator
) -> None:
    info = remote.info()
    assert (info.run, info.generation, info.env_id) == ("r", 2, ENV_ID)
    assert info.spaces.differs_from(SPACES) == ""
    assert (info.capacity, info.begin, info.end) == (100, 0, 40)
    batch = remote.sample(4096, rng, n_step=1, gamma=0.9)
    assert set(batch.row.tolist()) == set(range(40))
    assert np.array_equal(batch.next_obs, batch.obs + np.array([1, -1], np.float32))
    assert np.array_equal(batch.discount == 0.0, batch.row % 20 == 19)


def test_only_what_is_asked_for_is_sent(remote: RemoteReplay) -> None:
    """A tool that looks at rewards needs no observations."""
    for name in COLUMNS:
        sample = remote.ask(dataclasses.replace(REQUEST, fields=(name,)))
        found = [n for n in COLUMNS[:-1] if getattr(sample, n) is not None]
        assert found == ([] if name == "row" else [name])
        assert len(sample.row) == (64 if name == "row" else 0)


def test_what_cannot_be_served_is_refused_with_a_reason(
    buses: tuple[Bus, Bus], remote: RemoteReplay, rng: np.random.Generator
) -> None:
    """Not by silence, after which a client would ask again for ever."""
    with pytest.raises(MalformedMessageError, match=r"batch_size: found 4097, expected 1\.\.4096"):
        remote.sample(4097, rng)
    # Somebody else's client may not check.
    payload = encode(REQUEST).replace(b"\xaabatch_size\x40", b"\xaabatch_size\xce\x7f\xff\xff\xff")
    for unchecked, reason in [(payload, "batch_size: found 2147483647"), (b"?", "ReplayRequest: ")]:
        answer = buses[1].ask(KEYS.replay_sample, unchecked, 10.0)
        assert answer is not None
        assert reason in decode(answer, Refusal).reason
    with pytest.raises(UnreachableError, match="other/replay/info: no answer"):
        RemoteReplay(buses[1], Keys("other")).info()


def test_who_is_refused_for_now_asks_again() -> None:
    exchange = Exchange()
    info = ReplayInfo(run="r", generation=1, env_id="E", spaces=SPACES, capacity=9, begin=2, end=3)
    busy, never = Refusal(reason="busy", retry_s=0.001), Refusal(reason="never")
    answers = iter([encode(busy), encode(info), encode(never)])
    InProcessBus(exchange).answer(KEYS.replay_info, lambda _: next(answers))
    remote = RemoteReplay(InProcessBus(exchange), KEYS)
    assert remote.info().end == 3
    with pytest.raises(RefusedError, match="never"):
        remote.info()


def test_an_empty_replay_and_an_answer_too_large_are_refused(rng: np.random.Generator) -> None:
    """The limit of a message holds for the answer as well."""
    exchange = Exchange()
    zeros = np.zeros((1, 2000), np.float32)
    wide = Spaces(obs_size=2000, action_low=zeros[0, :1], action_high=zeros[0, :1] + 1)
    replay = Replay.in_memory(ENV_ID, wide, 10)
    ServedReplay(InProcessBus(exchange), KEYS, replay, generation=1, share=1.0).open()
    remote = RemoteReplay(InProcessBus(exchange), KEYS)
    with pytest.raises(RefusedError, match="found no transition to sample"):
        remote.sample(1, rng)
    narrow = make_segment([1.0, 2.0], [1.0])
    replay.insert(
        dataclasses.replace(narrow, obs=zeros, final_obs=zeros[0], suggestion=zeros[:, :1])
    )
    assert len(remote.sample(16, rng).row) == 16
    with pytest.raises(RefusedError, match=r"ReplaySample: found \d+ bytes, expected at most"):
        remote.sample(4096, rng)


def test_answers_take_their_share_of_the_time_and_no_more(replay: Replay) -> None:
    """With a quarter, the learner has three times what an answer took."""
    exchange = Exchange()
    now_s, rested = [0.0], []

    def clock() -> float:
        now_s[0] += 1.0  # everything takes a second
        return now_s[0]

    def rest(seconds: float) -> None:
        rested.append(seconds)
        now_s[0] += seconds

    bus = InProcessBus(exchange)
    ServedReplay(bus, KEYS, replay, 1, share=0.25, clock=clock, rest=rest).open()
    remote = RemoteReplay(InProcessBus(exchange), KEYS)
    for _ in range(4):
        remote.ask(REQUEST)
    # 3 s for its 1 s; one of them goes into looking at the clock again.
    assert rested == [2.0, 2.0, 2.0]
    now_s[0] += 100.0
    remote.ask(REQUEST)
    assert rested == [2.0, 2.0, 2.0]


def test_an_answer_that_took_long_does_not_cost_the_next_peer_its_answer(replay: Replay) -> None:
    """Such as the first draw by priorities, which compiles; a peer waits for 10 s."""
    exchange, rested = Exchange(), list[float]()
    times_s = iter([0.0, 0.0, 60.0, 60.0, 65.0, 65.0])
    bus = InProcessBus(exchange)
    clock = partial(next, times_s)
    ServedReplay(bus, KEYS, replay, 1, share=0.25, clock=clock, rest=rested.append).open()
    remote = RemoteReplay(InProcessBus(exchange), KEYS)
    remote.ask(REQUEST)
    remote.ask(REQUEST)
    assert rested == [5.0]


def test_many_clients_sample_while_the_learner_inserts_and_samples(
    remote: RemoteReplay, replay: Replay
) -> None:
    """Every answer is of one moment."""
    stop = threading.Event()

    def learn() -> None:
        rng = np.random.default_rng(0)
        for seq in itertools.count(2):
            if stop.is_set():
                return
            obs = [100.0 * seq + i for i in range(21)]
            replay.insert(make_segment(obs, [1.0] * 20, seq=seq, end="terminated"))
            batch = replay.sample(32, rng, prioritised=True)
            replay.update_priorities(batch.row, np.abs(batch.reward))

    def check(client: int) -> None:
        for i in range(30):
            seed, prioritised = 31 * client + i, bool(i % 2)
            sample = remote.ask(dataclasses.replace(REQUEST, seed=seed, prioritised=prioritised))
            assert sample.obs is not None
            assert sample.next_obs is not None
            row = np.array(sample.row)
            assert sample.begin <= row.min()
            assert row.max() < sample.end <= sample.begin + 100
            assert np.array_equal(sample.obs[:, 0], 100.0 * (row // 20) + row % 20)
            far = np.minimum(2, 20 - row % 20)
            assert np.array_equal(sample.next_obs[:, 0] - sample.obs[:, 0], far)

    with ThreadPoolExecutor(5) as pool:
        learning = pool.submit(learn)
        try:
            for future in [pool.submit(check, client) for client in range(4)]:
                future.result(timeout=50)
        finally:
            stop.set()
        learning.result(timeout=10)

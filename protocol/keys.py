"""The key expressions of one run; ``docs/protocol.md`` has them as a table.

The 2 is the major version of the protocol: peers of another one never meet.

==========================  =====================================================
``a2s/2/RUN/hello``         query: Hello -> Welcome or Refusal
``a2s/2/RUN/segment``       query: Segment -> Ack
``a2s/2/RUN/notice``        publication and query: Notice of the newest weights
``a2s/2/RUN/weights``       query: (empty) -> Weights, the newest
``a2s/2/RUN/recovery``      publication: RecoveryEvent
``a2s/2/RUN/actor/ACTOR``   publication: ActorStatus
``a2s/2/RUN/status``        query: (empty) -> RunStatus
``a2s/2/RUN/replay/info``   query: (empty) -> ReplayInfo
``a2s/2/RUN/replay/sample`` query: ReplayRequest -> ReplaySample or Refusal
``a2s/2/RUN/live/...``      liveliness tokens: ``learner``, ``actor/ACTOR``
==========================  =====================================================
"""

from dataclasses import dataclass

from a2s.protocol.errors import UsageError
from a2s.protocol.fields import NAME, is_name

MAJOR = 2
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of the run with this name.

    Raises:
        UsageError: The name cannot be part of a key.
    """

    run: str

    def __post_init__(self) -> None:
        """Check the name."""
        if not is_name(self.run):
            raise UsageError(f"run name: found {self.run!r}, expected {NAME}")

    def _key(self, rest: str) -> str:
        return f"a2s/{MAJOR}/{self.run}/{rest}"

    @property
    def hello(self) -> str:
        """Where actors say hello."""
        return self._key("hello")

    @property
    def hello_of_major_1(self) -> str:
        """Where actors of the protocol before this one say hello."""
        return f"a2s/{self.run}/hello"

    @property
    def segment(self) -> str:
        """Where segments go."""
        return self._key("segment")

    @property
    def notice(self) -> str:
        """Where new weights are announced, and may be asked for."""
        return self._key("notice")

    @property
    def weights(self) -> str:
        """Where the newest weights are pulled."""
        return self._key("weights")

    @property
    def recovery(self) -> str:
        """Where recoveries are announced."""
        return self._key("recovery")

    @property
    def status(self) -> str:
        """Where the learner tells how the run goes."""
        return self._key("status")

    @property
    def replay_info(self) -> str:
        """Where the learner tells what its replay holds."""
        return self._key("replay/info")

    @property
    def replay_sample(self) -> str:
        """Where batches are drawn from the learner's replay."""
        return self._key("replay/sample")

    def actor_status(self, actor: str = "*") -> str:
        """Where an actor, or every one, tells its account."""
        return self._key(f"actor/{actor}")

    def live_actor(self, actor: str = "*") -> str:
        """The token of one actor, or of every one."""
        return self._key(f"live/actor/{actor}")

    @property
    def live_learner(self) -> str:
        """The learner's token."""
        return self._key("live/learner")

"""The key expressions of one run; ``docs/protocol.md`` says what travels on each.

The 2 is the major version of the protocol: peers of another one never meet.
"""

from a2s.protocol.checks import NAME, is_name
from a2s.protocol.errors import UsageError
from a2s.protocol.transport import Bus

MAJOR = 2
ANY_LEARNER = f"a2s/{MAJOR}/*/live/learner"
_LOOK_S, _MOST_NAMED = 1.0, 5
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"


def other_runs(bus: Bus, run: str) -> str:
    """Say which other runs have a learner where ``bus`` leads; empty: none.

    For the end of a message: ``"; found run 'hop' there, name it with --run"``.
    """
    found = {key.split("/")[2] for key in bus.present(ANY_LEARNER, _LOOK_S)} - {run}
    if not found:
        return ""
    names = ", ".join(map(repr, sorted(found)[:_MOST_NAMED]))
    return f"; found {'run' if len(found) == 1 else 'runs'} {names} there, name it with --run"


class Keys:
    """The keys of the run with this name.

    Raises:
        UsageError: The name cannot be part of a key.
    """

    def __init__(self, run: str) -> None:
        if not is_name(run):
            raise UsageError(f"run name: found {run!r}, expected {NAME}")
        self.run = run
        self._prefix = prefix = f"a2s/{MAJOR}/{run}"
        self.hello = f"{prefix}/hello"  # query: Hello -> Welcome or Refusal
        self.hello_of_major_1 = f"a2s/{run}/hello"  # query of protocol 1: Hello -> Refusal
        self.segment = f"{prefix}/segment"  # query: Segment -> Ack
        self.notice = f"{prefix}/notice"  # publication and query: newest Notice
        self.weights = f"{prefix}/weights"  # query: newest Weights
        self.recovery = f"{prefix}/recovery"  # publication: RecoveryEvent
        self.status = f"{prefix}/status"  # query, and publication at the end of the run: RunStatus
        self.replay_info = f"{prefix}/replay/info"  # query: ReplayInfo
        self.replay_sample = f"{prefix}/replay/sample"  # query: ReplayRequest -> ReplaySample
        self.evaluation_task = f"{prefix}/evaluation/task"  # query: EvaluationRequest -> its Task
        self.evaluation_result = f"{prefix}/evaluation/result"  # query: EvaluationResult
        self.live_learner = f"{prefix}/live/learner"  # liveliness token

    def hello_of(self, actor: str = "*") -> str:
        """Query, as `hello`: of this actor alone, or of every one."""
        return f"{self.hello}/{actor}"

    def segment_of(self, actor: str = "*") -> str:
        """Query, as `segment`: of this actor alone, or of every one."""
        return f"{self.segment}/{actor}"

    def actor_status(self, actor: str = "*") -> str:
        """Publication: the ActorStatus of one actor, or of every one."""
        return f"{self._prefix}/actor/{actor}"

    def live_actor(self, actor: str = "*") -> str:
        """Liveliness token of one actor, or of every one."""
        return f"{self._prefix}/live/actor/{actor}"

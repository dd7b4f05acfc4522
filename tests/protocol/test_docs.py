"""docs/protocol.md against the code: somebody may be writing an actor from the page alone."""

import json
import re
import types
import typing
from dataclasses import MISSING, asdict, fields, is_dataclass
from pathlib import Path

import numpy as np
import onnx
import pytest

from a2s.learner.export.graph import CONTRACT
from a2s.learner.export.metadata import policy_metadata
from a2s.learner.own_replay import OwnReplay
from a2s.learner.run.config import RunConfig
from a2s.protocol.codec import MAX_BYTES, SCHEMA_VERSION, Message, decode, encode
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.fields import MOST_METRICS, Spaces
from a2s.protocol.keys import DEFAULT_ENDPOINT, Keys
from a2s.protocol.messages import (
    MOST_PLAYED,
    MOST_SUGGESTED,
    Ack,
    EpisodeMetric,
    Segment,
    Verdict,
)

PAGE = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text()
DESCRIBED = (Spaces, EnvConfig, EpisodeMetric, *typing.get_args(Message))


def section(heading: str) -> str:
    """Return what stands below a heading, up to the next one of any level."""
    (found,) = re.findall(rf"^#+ {re.escape(heading)}\n(.*?)(?=^#|\Z)", PAGE, re.M | re.S)
    return str(found)


def rows(text: str) -> list[list[str]]:
    """Return the cells of every table row below its header, without backquotes."""
    lines = [line.strip("|") for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip().strip("`") for cell in line.split(" | ")] for line in lines]
    header = [i for i, line in enumerate(lines) if set(line) <= set("-|")]
    skipped = {i for line in header for i in (line - 1, line)}
    return [row for i, row in enumerate(cells) if i not in skipped]


def written(hint: object) -> str:
    """Say in the words of the page what a field's type is."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is types.UnionType:
        return f"{written(arguments[0])} or nil"
    if origin is tuple:
        return f"list of {written(arguments[0])}"
    if origin is typing.Literal:
        return "str"
    if origin is np.ndarray:
        return "array"
    assert isinstance(hint, type)
    if is_dataclass(hint):
        return f"map {hint.__name__}"
    return "bin" if hint is bytes else hint.__name__


@pytest.mark.parametrize("kind", DESCRIBED)
def test_the_table_of_a_message_has_exactly_its_fields_and_their_types(kind: type) -> None:
    """In the same order, with a meaning each."""
    hints = typing.get_type_hints(kind)
    table = rows(section(kind.__name__))
    found = [(name, re.sub(r" \[.*\]", "", type_)) for name, type_, _ in table]
    assert found == [(f.name, written(hints[f.name])) for f in fields(kind)]
    assert all(meaning for *_, meaning in table)


@pytest.mark.parametrize("kind", DESCRIBED)
def test_the_defaults_are_those_of_the_code(kind: type) -> None:
    """Whoever reads a message without the field has to take the same."""
    found = {
        name: json.loads(default[1].replace("nil", "null"))
        for name, _, meaning in rows(section(kind.__name__))
        if (default := re.search(r"; default (.*)$", meaning))
    }
    assert found == {
        f.name: list(f.default) if isinstance(f.default, tuple) else f.default
        for f in fields(kind)
        if f.default is not MISSING
    }


def test_there_is_no_message_that_does_not_exist() -> None:
    """One that was removed from the code goes from the page."""
    headings = re.findall(r"^### (\w+)$", section_of_messages(), re.M)
    assert headings == [kind.__name__ for kind in DESCRIBED]


def section_of_messages() -> str:
    """Return the part of the page that describes messages."""
    return PAGE.split("\n## Messages\n")[1].split("\n## ")[0]


def test_the_size_limits_are_those_of_the_code() -> None:
    """A sender checks them before a receiver does."""
    table = [row for row in rows(section("Encoding")) if row[1].isdigit()]
    assert {name: int(limit) for name, limit in table} == {
        kind.__name__: limit for kind, limit in MAX_BYTES.items()
    }


def test_the_largest_numbers_are_those_of_the_code() -> None:
    """An actor drops what is larger."""
    found = re.findall(r" from -(\S+) to (\S+\d)", section("Segment").split("|")[0])
    assert [(float(low), float(high)) for low, high in found] == [
        (most, most) for most in (MOST_PLAYED, MOST_SUGGESTED, OwnReplay.max_suggestion)
    ]


def test_the_most_metrics_are_those_of_the_code() -> None:
    """Those of the run and those of a segment: `is_success` is always one."""
    assert f"at most {MOST_METRICS};" in section("Segment")
    assert f"at most {MOST_METRICS - 1} others;" in section("EnvConfig")


def test_the_keys_are_those_of_the_code() -> None:
    """Each at least once, and no other."""
    keys = Keys("RUN")
    assert {row[0] for row in rows(section("Keys"))} == {
        keys.hello,
        keys.hello_of_major_1,
        keys.segment,
        keys.notice,
        keys.weights,
        keys.recovery,
        keys.status,
        keys.replay_info,
        keys.replay_sample,
        keys.actor_status("ACTOR"),
        keys.live_learner,
        keys.live_actor("ACTOR"),
    }


def test_the_verdicts_version_and_endpoint_are_those_of_the_code() -> None:
    """What is written in running text changes with the code as well."""
    verdicts = [row[0] for row in rows(section("Sending"))]
    assert verdicts == list(typing.get_args(Verdict))
    assert f'`"a2s"`: the major version, the integer **{SCHEMA_VERSION}**' in PAGE
    assert f"This is version {SCHEMA_VERSION} of the protocol." in PAGE
    assert f'`["{DEFAULT_ENDPOINT}"]`' in PAGE


def test_the_metadata_of_a_graph_are_those_of_the_code(
    make_graph: typing.Callable[..., bytes],
) -> None:
    """What a graph says of itself, and what the learner knows of the environment."""
    spaces = Spaces(
        obs_size=1,
        action_low=np.array([-1], np.float32),
        action_high=np.array([1], np.float32),
        obs_offset=np.array([1000], np.float32),
    )
    told = policy_metadata(RunConfig(env="E"), spaces, [("position", 1)])
    own = {entry.key for entry in onnx.load_from_string(make_graph()).metadata_props}
    table = rows(section("The graph"))
    first = [name for name, *_ in table].index("contract")
    assert {name for name, *_ in table[first:]} == {*own, *told}
    assert table[first][1].startswith(f"{CONTRACT}`:")
    assert json.loads(told["environment"]).keys() == {f.name for f in fields(EnvConfig)}


@pytest.mark.parametrize(("index", "kind"), [(0, Ack), (1, Segment)])
def test_the_hex_dumps_are_messages_with_the_values_beside_them(
    index: int, kind: type[Ack | Segment]
) -> None:
    """To the byte, as our encoder writes them, and the text column beside them as well."""
    dumps = re.findall(r"```json\n(.*?)```\n\n```hexdump\n(.*?)```", PAGE, re.S)
    assert len(dumps) == 2
    values, dump = dumps[index]
    lines = re.findall(r"^([0-9a-f]{8})  ((?:[0-9a-f]{2} ?)+) +\|(.*)\|$", dump, re.M)
    assert len(lines) == len(dump.splitlines())
    assert [int(offset, 16) for offset, _, _ in lines] == list(range(0, 16 * len(lines), 16))
    payload = bytes.fromhex("".join(line for _, line, _ in lines))
    text = "".join(chr(byte) if 32 <= byte < 127 else "." for byte in payload)
    assert text == "".join(line for *_, line in lines)

    message = decode(payload, kind)
    assert json.loads(values) == {
        name: value.tolist() if isinstance(value, np.ndarray) else _listed(value)
        for name, value in asdict(message).items()
    }
    assert encode(message) == payload


def _listed(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value


def test_no_line_is_longer_than_a_screen() -> None:
    """Tables excepted, which cannot be broken."""
    assert [x for x in PAGE.splitlines() if len(x) > 160 and not x.startswith("|")] == []

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
from a2s.learner.run.run_config import RunConfig
from a2s.protocol.checks import MAX_METRICS
from a2s.protocol.codec import MAX_BYTES, Message, decode, encode
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.evaluation_messages import EvaluatedEpisode
from a2s.protocol.fields import Spaces
from a2s.protocol.keys import Keys
from a2s.protocol.messages import (
    MAX_PLAYED,
    MAX_SUGGESTED,
    Ack,
    EpisodeMetric,
    Segment,
    Verdict,
)

PAGE = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text()
DESCRIBED = (Spaces, EnvConfig, EpisodeMetric, EvaluatedEpisode, *typing.get_args(Message))


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
def test_the_table_of_a_message_has_exactly_its_fields_types_and_defaults(kind: type) -> None:
    """In the same order, with a meaning each."""
    hints, table = typing.get_type_hints(kind), rows(section(kind.__name__))
    found = [(name, re.sub(r" \[.*\]", "", type_)) for name, type_, _ in table]
    assert found == [(f.name, written(hints[f.name])) for f in fields(kind)]
    assert all(meaning for *_, meaning in table)
    defaults = {
        name: json.loads(default[1].replace("nil", "null"))
        for name, _, meaning in table
        if (default := re.search(r"; default (.*)$", meaning))
    }
    assert defaults == {f.name: listed(f.default) for f in fields(kind) if f.default is not MISSING}


def listed(value: object) -> object:
    """Turn a tuple into what JSON has for it."""
    return list(value) if isinstance(value, tuple) else value


def test_the_page_has_the_messages_and_keys_that_exist_and_no_others() -> None:
    """One that was removed from the code goes from the page."""
    messages = PAGE.split("\n## Messages\n")[1].split("\n## ")[0]
    assert re.findall(r"^### (\w+)$", messages, re.M) == [kind.__name__ for kind in DESCRIBED]
    keys = Keys("RUN")
    named = {key for name, key in vars(keys).items() if name not in ("run", "_prefix")}
    named |= {keys.actor_status("ACTOR"), keys.live_actor("ACTOR")}
    named |= {keys.hello_of("ACTOR"), keys.segment_of("ACTOR")}
    assert {row[0] for row in rows(section("Keys"))} == named
    assert [row[0] for row in rows(section("Sending"))] == list(typing.get_args(Verdict))


def test_the_limits_are_those_of_the_code() -> None:
    """A sender checks them before a receiver does."""
    table = [row for row in rows(section("Encoding")) if row[1].isdigit()]
    assert {name: int(limit) for name, limit in table} == {
        kind.__name__: limit for kind, limit in MAX_BYTES.items()
    }
    found = re.findall(r" from -(\S+) to (\S+\d)", section("Segment").split("|")[0])
    assert [(float(low), float(high)) for low, high in found] == [
        (most, most) for most in (MAX_PLAYED, MAX_SUGGESTED, OwnReplay.max_suggestion)
    ]
    assert f"at most {MAX_METRICS};" in section("Segment")
    assert f"at most {MAX_METRICS - 1} others;" in section("EnvConfig")  # and is_success


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
        name: value.tolist() if isinstance(value, np.ndarray) else listed(value)
        for name, value in asdict(message).items()
    }
    assert encode(message) == payload

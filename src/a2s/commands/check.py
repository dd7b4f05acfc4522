"""``a2s check``: a page on whether an environment can be trained on, and its properties."""

import textwrap
from typing import Any

_WIDTH = 100
_SHOWN = 8


def page(found: dict[str, Any], command: str) -> str:
    """Give the findings on one page, and the command that trains on it."""
    lows, highs = found["action_low"], found["action_high"]
    lines = [
        f"environment   {found['env']}",
        f"observations  {_observations(found)}",
        f"actions       {_count(len(lows))}, from {min(lows):g} to {max(highs):g}{_repeat(found)}",
        f"episodes      {_episodes(found)}",
        f"rewards       from {found['rewards'][0]:.4g} to {found['rewards'][1]:.4g}",
        f"info          {_info(found)}",
        f"the same seed {'repeats' if found['repeats'] else 'does NOT repeat, nor do runs'}",
        f"speed         {found['steps_per_s']:,.0f} actions/s, at random, in one process",
    ]
    if found["unusable_steps"]:
        lines.append(
            f"unusable      {found['unusable_steps']:,} of {found['steps']:,} steps have numbers "
            f"that are NaN, infinite or above 1e10, first {found['first_unusable']}: dropped"
        )
    if found["remarks"]:
        lines.append("Gymnasium's checker says")
        for remark in found["remarks"]:
            lines += textwrap.wrap(
                remark, _WIDTH, initial_indent="  - ", subsequent_indent="    ", max_lines=4
            )
    lines.append(f"It can be trained on: {command}")
    return "\n".join(lines)


def _count(numbers: int) -> str:
    return f"{numbers:,} number{'' if numbers == 1 else 's'}"


def _observations(found: dict[str, Any]) -> str:
    stack, layout = found["frame_stack"], found["obs_layout"]
    latest = layout[-len(layout) // stack :] if stack > 1 else layout
    parts = [f"{name.partition(', ')[0]} {size}" for name, size in latest]
    more = f", and {len(parts) - _SHOWN} more parts" if len(parts) > _SHOWN else ""
    of = f"the latest {stack} of " if stack > 1 else ""
    is_plain = len(parts) == 1 and not of
    return _count(found["obs_size"]) + (
        "" if is_plain else f": {of}{', '.join(parts[:_SHOWN])}{more}"
    )


def _repeat(found: dict[str, Any]) -> str:
    times = found["action_repeat"]
    return f"; each for {times} steps of the environment" if times > 1 else ""


def _episodes(found: dict[str, Any]) -> str:
    limit, lengths = found["max_episode_steps"], found["episode_lengths"]
    limited = f"its limit is {limit:,} of its steps" if limit else "no limit is registered"
    if not lengths:
        return f"none ended within {found['steps']:,} actions; {limited}"
    ends = f"{found['terminated']} terminated, {found['truncated']} truncated"
    spans = f"{min(lengths):,} to {max(lengths):,} actions long"
    return f"{len(lengths)} ended ({ends}), {spans}; {limited}"


def _info(found: dict[str, Any]) -> str:
    kept = ", ".join(found["info_metrics"]) or "no metric"
    others = found["other_numbers"]
    asked = f"; also {', '.join(others[:_SHOWN])} (--info-metric {others[0]})" if others else ""
    return kept + asked

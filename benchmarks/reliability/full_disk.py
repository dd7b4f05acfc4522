"""A disk that is full at each write in turn: once, and from there on until the process ends.

``python -m reliability.full_disk --stride 1``. The run goes on, or ends with one line; nothing that
was acknowledged is lost, and ``--resume`` with room goes on to what a run without it learns. Then
``a2s train`` itself, at every ``--real-stride``th write.
"""

import argparse
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from reliability.commands import Commands, wait_for
from reliability.faults import Fault, Faults
from reliability.run_files import not_whole, unbalanced
from reliability.scripted import ScriptedRun
from reliability.trial import Result, folder, tell
from system_helpers import FAST, OFF_POLICY, REACH

SHORT = {
    "lockstep": {"total_steps": 400, "checkpoint_every_updates": 3},
    "off-policy": {"total_steps": 100, "checkpoint_every_updates": 20},
}
TRAIN = {
    "on-policy": (*FAST, "--total-steps", "1000", "--episodes", "1"),
    "off-policy": (
        *OFF_POLICY, "--set", "warm_up_steps=100", "--total-steps", "300", "--episodes", "1",
    ),
}  # fmt: skip
FULL = {"once": Fault.FULL_ONCE, "from there": Fault.FULL_FROM_THERE}


def scripted(way: str, first: int, stride: int, faults: Faults, notes: Path) -> Result:
    """Every ``stride``th write of the learner of scripted actors."""
    result = Result(
        f"full disk, {way}, scripted actors",
        "goes on or ends with one line; resumed it equals an undisturbed run, to the bit",
    )
    path, options = faults.place / "run", SHORT[way]
    faults.forget()
    faults.arm(Fault.NOTHING)
    run = ScriptedRun(way, path, notes, **options)
    ended = run.start()
    assert ended.code == 0, ended.words
    undisturbed, writes = run.learned(), faults.writes()
    for at in range(first, len(writes) + 1, stride):
        for name, fault in FULL.items():
            run = ScriptedRun(way, path, notes, **options)
            faults.arm(fault, at)
            ended = run.start()
            faults.arm(Fault.NOTHING)
            wrong = ended.defect if not ended.is_one_line else ""
            is_over = ended.code == 0 and (path / "summary.json").exists()
            again = ended if is_over else run.start()
            wrong = wrong or (again.defect and f"and then, {again.defect}")
            difference = ""
            if again.code == 0 and (path / "summary.json").exists():
                difference = undisturbed.difference(run.learned())
            result.add(
                wrong,
                difference and f"{difference} differ",
                of=f"{name} {at} {writes[at - 1]}, code {ended.code}",
            )
    result.figures["writes"] = str(len(writes))
    return result


def real(variant: str, first: int, stride: int, faults: Faults) -> Result:
    """Every ``stride``th write of ``a2s train`` and all that it starts."""
    result = Result(
        f"full disk, {variant}, a2s train",
        "ends by itself, with one line if it fails; a2s doctor is content; --resume balances",
    )
    path = faults.place / f"train-{variant}"
    new = (*REACH, *TRAIN[variant])
    with Commands(faults.place.parent) as commands:
        arguments = ("--run-dir", str(path), "--metrics-port", "-1")
        faults.arm(Fault.NOTHING)
        undisturbed = _ends(commands, ("train", *new, *arguments), faults.environ())
        assert undisturbed == ("", 0), undisturbed
        writes = faults.count()  # of one without faults: others end early
        shutil.rmtree(path)
        for at in range(first, writes + 1, stride):
            for name, fault in FULL.items():
                faults.arm(fault, at)
                told = _ends(commands, ("train", *new, *arguments), faults.environ())
                faults.arm(Fault.NOTHING)
                is_begun = (path / "config.toml").exists()
                wrong = told[0] or (not_whole(path) if is_begun else "")
                go_on = ("--resume", "--episodes", "1") if is_begun else new
                again = _ends(commands, ("train", *go_on, *arguments), os.environ)
                failed = f"then code {again[1]}" if again[1] else ""
                balance = unbalanced(path) if not again[1] else ""
                result.add(wrong, again[0], failed, balance, of=f"{name} {at}, code {told[1]}")
                shutil.rmtree(path, ignore_errors=True)
    result.figures["writes"] = str(writes)
    return result


def _ends(
    commands: Commands, arguments: tuple[str, ...], environ: Mapping[str, str]
) -> tuple[str, int]:
    """What is wrong about how a command ends, and its exit code."""
    command = commands.start(*arguments, environ=environ)
    try:
        wait_for(lambda: command.process.poll() is not None, "the end")
    except TimeoutError:
        command.process.kill()
        return f"hangs: {command.text()[-200:]}", command.process.wait()
    code, words = command.process.returncode, command.text()
    last = words.strip().splitlines()[-1:] or [""]
    if "Traceback" in words:
        return f"a traceback: {last[0]}", code
    if code == 0 or (code == 1 and last[0].startswith("a2s: ")):
        return "", code
    return f"code {code}: {last[0]}", code


def main() -> None:
    """Parse, fill, tell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stride", type=int, default=40, help="scripted; 0: none")
    parser.add_argument("--real-stride", type=int, default=0, help="a2s train; 0: none")
    parser.add_argument("--first", type=int, default=1, help="the first write that fails")
    options = parser.parse_args()
    with folder() as place:
        faults = Faults(place)
        faults.enter("reliability.full_disk", logged=True)
        results = []
        if options.stride:
            notes, first, stride = place / "notes", options.first, options.stride
            results += [scripted(way, first, stride, faults, notes) for way in SHORT]
        if options.real_stride:
            results += [real(v, options.first, options.real_stride, faults) for v in TRAIN]
    tell(results)


if __name__ == "__main__":
    main()

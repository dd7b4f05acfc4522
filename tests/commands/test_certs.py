"""``a2s certs``, and what commands make of ``--tls``, ``--password-file`` and ``--insecure``."""

import stat
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from a2s.commands.certs import make
from a2s.commands.doctor import Finding, examine
from a2s.protocol.certificates import Authority, read
from a2s.protocol.identity import Security

NOW = datetime.now(UTC)
Run = Callable[..., tuple[int, str, str]]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


def test_certificates_are_made_for_all_with_keys_that_only_their_owner_reads(
    a2s: Run, tmp_path: Path
) -> None:
    code, out, error = a2s(
        "certs", "made", "--host", "10.0.0.1", "--host", "Lab.example", "--actor", "x"
    )
    assert (code, error) == (0, "")
    folder = tmp_path / "made"
    assert [line.split()[0] for line in out.splitlines()] == [
        "made/learner", "made/actor", "made/actor-x", "made/viewer", "made/ca.key"
    ]  # fmt: skip
    assert {each.name for each in folder.iterdir()} == {
        "ca.pem", "ca.key", "learner", "actor", "actor-x", "viewer"
    }  # fmt: skip
    assert set(read(folder / "learner", NOW).hosts) == {
        "10.0.0.1", "lab.example", "localhost", "127.0.0.1", "::1"
    }  # fmt: skip
    for name in ("actor", "actor-x", "viewer"):
        held = read(folder / name, NOW)
        assert (held.name, held.hosts) == (name, ())
        assert timedelta(days=364) < held.expires - NOW < timedelta(days=366)
    assert (folder / "learner" / "names.txt").read_text() == "actor\nviewer\nactor-x\n"
    for file in folder.rglob("*"):
        assert not stat.S_IMODE(file.stat().st_mode) & (0o077 if "key" in file.name else 0o022)


def test_called_again_it_makes_only_what_is_missing_or_soon_expires(tmp_path: Path) -> None:
    folder = tmp_path / "certs"
    list(make(folder, ["far"], ["x", "y"], [], 90))
    first = contents(folder)
    list(make(folder, [], [], [], 90))
    assert contents(folder) == first

    list(make(folder, ["near"], ["z"], [], 90))
    second = contents(folder)
    changed = {name for name in second if second[name] != first.get(name)}
    assert {name.partition("/")[0] for name in changed} == {"learner", "actor-z"}
    assert "near" in read(folder / "learner", NOW).hosts
    assert "far" not in read(folder / "learner", NOW).hosts

    late = Authority.read(folder, NOW).issue("actor-x", [], 20, NOW)
    for name, data in late.items():
        (folder / "actor-x" / name).write_bytes(data)
    (folder / "actor-y" / "key.pem").write_text("torn")
    list(make(folder, [], [], [], 90))
    for name in ("actor-x", "actor-y"):
        assert read(folder / name, NOW).expires - NOW > timedelta(days=80)


def test_a_name_that_was_taken_out_of_the_list_stays_out(tmp_path: Path) -> None:
    """Its owner is kept out, also when certificates are renewed."""
    folder = tmp_path / "certs"
    list(make(folder, [], ["lost"], [], 90))
    (folder / "learner" / "names.txt").write_text("actor\nviewer\n")
    list(make(folder, [], ["new", "lost"], [], 90))
    assert (folder / "learner" / "names.txt").read_text() == "actor\nviewer\nactor-new\n"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--actor", "a b"], "found the name 'actor-a b', expected actor, viewer, actor-NAME"),
        (["--host", "tcp/10.0.0.1"], "--host: found 'tcp/10.0.0.1', expected a name or an address"),
        (["--host", "10.0.0.1:7447"], "--host: found '10.0.0.1:7447', expected a name"),
        (["--days", "0"], "--days: found 0, expected 1 to 3650"),
        (["file/certs"], "file/certs: Not a directory"),
        (["torn"], "torn/ca.key: No such file or directory; expected a file of `a2s certs`"),
    ],
)
def test_a_mistake_is_one_line(a2s: Run, tmp_path: Path, arguments: list[str], said: str) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "torn").mkdir()
    list(make(tmp_path / "torn", [], [], [], 90))
    (tmp_path / "torn" / "ca.key").unlink()
    code, _, error = a2s("certs", *arguments)
    assert (code, error.count("\n")) == (2, 1)
    assert said in error


@pytest.mark.parametrize("command", ["learner", "train"])
def test_a_learner_that_anybody_can_reach_wants_to_know_its_peers(a2s: Run, command: str) -> None:
    """Nothing is made before; --insecure, or a way to know them, lets it begin."""
    code, _, error = a2s(command, "--listen", "tcp/0.0.0.0:7447")
    assert (code, error) == (
        2,
        "a2s: --listen: found tcp/0.0.0.0:7447, which others can reach, without --tls or "
        "--password-file; make certificates with `a2s certs`, or add --insecure if the network "
        "keeps strangers out\n",
    )
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["learner", "--tls", "no"], "--tls: found no folder no; make one with `a2s certs`"),
        (
            ["train", "--tls", "certs/actor"],
            "found the certificate of 'actor', expected that of le",
        ),
        (["train", "--tls", "certs/learner"], "certificate of 'learner', expected that of actor"),
        (["actor", "--tls", "certs/viewer"], "certificate of 'viewer', expected that of actor"),
        (["actor", "--connect", "tls/far:7447"], "without certificates, expected --tls DIR"),
        (["status", "--tls", "no"], "--tls: found no folder no"),
        (["replay", "info", "--connect", "tcp/far:1", "--tls", "certs/actor"], "of 'actor', expec"),
        (
            ["learner", "--replay-from", "r", "--connect", "tcp/far:1", "--tls", "certs/actor"],
            "of 'actor', expected that of learner or viewer",
        ),
        (["actor", "--password-file", "no"], "--password-file: no: No such file or directory"),
        (["learner", "--password-file", "no", "--tls", "no"], "found with --tls, expected one"),
    ],
)
def test_what_is_wrong_with_a_certificate_is_said_by_every_command(
    a2s: Run, tmp_path: Path, words: list[str], said: str
) -> None:
    list(make(tmp_path / "certs", [], [], [], 90))
    code, _, error = a2s(*words)
    assert (code, error.count("\n")) == (2, 1)
    assert said in error


def test_doctor_says_who_this_is_and_what_is_wrong_with_it(tmp_path: Path) -> None:
    list(make(tmp_path, [], ["x"], [], 20))

    def found(tls: Path, name: str) -> Finding:
        looks = examine("tcp/127.0.0.1:9", "default", Security(tls=str(tls)))
        return next(each for each in looks if each.name == name)

    own = found(tmp_path / "actor-x", "identity")
    assert (own.state, own.found.partition(" until ")[0]) == ("note", "actor-x, a certificate")
    assert own.remedy.startswith("make a new one with `a2s certs`")
    assert found(tmp_path, "learner").found == "none at tls/127.0.0.1:9"
    assert found(tmp_path / "no", "identity")[1:] == (
        "fail", f"--tls: found no folder {tmp_path}/no", "make one with `a2s certs`, or copy it"
    )  # fmt: skip


def test_a_password_is_in_no_configuration(
    a2s: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor is the way to it: it belongs to a machine, not to a run."""
    (tmp_path / "users").write_text("actor:secret\n")
    monkeypatch.setenv("A2S_PASSWORD", "actor:secret")
    code, out, error = a2s("learner", "--print-config", "--password-file", "users")
    assert (code, error) == (0, "")
    assert "secret" not in out
    assert "users" not in out

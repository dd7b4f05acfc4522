"""What a peer finds wrong with its own files, before it opens a session: one line each."""

import re
import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from a2s.protocol import passwords
from a2s.protocol.certificates import Authority
from a2s.protocol.errors import UsageError
from a2s.protocol.identity import Security, is_local
from a2s.protocol.keys import Keys

NOW = datetime.now(UTC)
ROLES = "actor, viewer, actor-NAME or viewer-NAME, NAME of A-Z a-z 0-9 _ and -"


@pytest.fixture
def folder(certs: Path, tmp_path: Path) -> Path:
    """A copy of an actor's folder, to be spoilt."""
    return Path(shutil.copytree(certs / "actor", tmp_path / "actor"))


def write(folder: Path, files: dict[str, bytes]) -> None:
    for name, data in files.items():
        (folder / name).write_bytes(data)


def expired(folder: Path, certs: Path) -> None:
    long_ago = NOW - timedelta(days=30)
    write(folder, Authority.read(certs, NOW).issue("actor", [], 7, long_ago))


def not_yet(folder: Path, certs: Path) -> None:
    write(folder, Authority.read(certs, NOW).issue("actor", [], 7, NOW + timedelta(days=1)))


def foreign(folder: Path, certs: Path) -> None:
    ours = (folder / "ca.pem").read_bytes()
    write(folder, {**Authority.new(NOW).issue("actor", [], 7, NOW), "ca.pem": ours})


def unnamed(folder: Path, certs: Path) -> None:
    write(folder, Authority.read(certs, NOW).issue("somebody", [], 7, NOW))


def other_key(folder: Path, certs: Path) -> None:
    shutil.copy(certs / "viewer" / "key.pem", folder)


def no_key(folder: Path, certs: Path) -> None:
    (folder / "key.pem").unlink()


def garbage(folder: Path, certs: Path) -> None:
    (folder / "cert.pem").write_text("garbage")


def swapped(folder: Path, certs: Path) -> None:
    shutil.copy(folder / "cert.pem", folder / "key.pem")


def gone(folder: Path, certs: Path) -> None:
    shutil.rmtree(folder)


DATE = r"\d{4}-\d\d-\d\d \d\d:\d\d"


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (
            expired,
            f"DIR/cert.pem: expired on {DATE} UTC; make a new one with `a2s certs` where the "
            "authority is, and copy it here",
        ),
        (
            not_yet,
            f"DIR/cert.pem: valid from {DATE} UTC on, and here it is {DATE}; set the clock of this "
            "machine",
        ),
        (
            foreign,
            "DIR/cert.pem: found a certificate of another authority than DIR/ca.pem, expected one "
            "of the same; copy the whole folder that `a2s certs` made",
        ),
        (
            unnamed,
            "DIR/cert.pem: found the certificate of 'somebody', expected that of actor; "
            "name its folder with --tls",
        ),
        (
            other_key,
            "DIR/key.pem: found the key of another certificate than DIR/cert.pem; "
            "copy both from the same folder",
        ),
        (
            no_key,
            "DIR/key.pem: No such file or directory; expected a file of `a2s certs` that this user "
            "can read",
        ),
        (garbage, "DIR/cert.pem: found no certificate in it, expected one in PEM"),
        (swapped, "DIR/key.pem: found no key in it, expected one in PEM, unencrypted"),
        (gone, "--tls: found no folder DIR; make one with `a2s certs`, or copy it"),
    ],
)
def test_what_is_wrong_with_a_folder_is_one_line_with_what_to_do(
    folder: Path, certs: Path, spoil: Callable[[Path, Path], None], said: str
) -> None:
    assert Security(tls=str(folder)).peer("actor").name == "actor"
    spoil(folder, certs)
    with pytest.raises(UsageError) as caught:
        Security(tls=str(folder)).peer("actor")
    assert re.fullmatch(said, str(caught.value).replace(str(folder), "DIR"))


def test_a_certificate_of_another_role_is_refused(certs: Path) -> None:
    """Also that of an actor where a learner listens."""
    keys = Keys("r")
    for role, name in (("actor", "viewer"), ("viewer", "actor")):
        with pytest.raises(UsageError, match=f"found the certificate of '{name}', expected that"):
            Security(tls=str(certs / name)).peer(role)
    with pytest.raises(UsageError, match="found the certificate of 'actor', expected that of lea"):
        Security(tls=str(certs / "actor")).listener(keys, "tls/127.0.0.1:7447")


def test_the_folder_of_the_authority_will_do_for_every_role(certs: Path) -> None:
    """Each command takes the folder in it that is for it."""
    own = Security(tls=str(certs))
    assert [own.peer(role).name for role in ("actor", "viewer")] == ["actor", "viewer"]
    assert own.listener(Keys("r"), "tls/0.0.0.0:7447").name == "learner"
    assert Security(tls=str(certs / "actor-lab1")).peer("actor").name == "actor-lab1"


def test_the_learner_wants_to_know_whom_it_lets_in(certs: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(certs / "learner", tmp_path / "learner"))
    own, keys = Security(tls=str(folder)), Keys("r")
    (folder / "names.txt").write_text("actor\nlearner\n")
    with pytest.raises(UsageError, match=rf"names.txt: found 'learner', expected {ROLES}"):
        own.listener(keys, "tls/0.0.0.0:7447")
    (folder / "names.txt").unlink()
    with pytest.raises(UsageError, match=r"names.txt: No such file or directory; expected the nam"):
        own.listener(keys, "tls/0.0.0.0:7447")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("actor:a\nviewer\n", r", line 2: expected USER:PASSWORD, for example actor:PASSWORD$"),
        ("actor:\n", r", line 1: expected USER:PASSWORD"),
        ("actor: a\n", r", line 1: expected USER:PASSWORD"),
        ("bob:secret\n", rf", line 1: found user 'bob', expected {ROLES}$"),
        ("learner:secret\n", ", line 1: found user 'learner', expected"),
        ("actor:a\nactor:b\n", ", line 2: found user 'actor' once more, expected one line for"),
        ("", ": empty, expected lines USER:PASSWORD$"),
    ],
)
def test_a_mistake_in_a_file_of_passwords_is_one_line_without_them(
    tmp_path: Path, text: str, said: str
) -> None:
    (tmp_path / "users").write_text(text)
    with pytest.raises(UsageError, match=said) as caught:
        Security(password_file=str(tmp_path / "users")).listener(Keys("r"), "tcp/0.0.0.0:7447")
    assert "secret" not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_peer_takes_the_first_user_of_its_role(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a file, else of the variable; a file without one is refused."""
    (tmp_path / "users").write_text("viewer:v\nactor-lab1:with:colon\nactor:a\n")
    own = Security(password_file=str(tmp_path / "users"))
    assert own.peer("actor").settings["transport/auth/usrpwd"] == {
        "user": "actor-lab1", "password": "with:colon"
    }  # fmt: skip
    (tmp_path / "users").write_text("viewer:v\n")
    with pytest.raises(UsageError, match=r"found no line of a user actor, expected one such as ac"):
        own.peer("actor")
    assert Security().peer("actor").name == ""
    monkeypatch.setenv("A2S_PASSWORD", "actor:secret")
    assert Security().peer("actor").name == "actor"
    assert own.peer("viewer").name == "viewer"
    with pytest.raises(UsageError, match=r"^A2S_PASSWORD: found user 'actor', expected one of vi"):
        Security().peer("viewer")


@pytest.mark.parametrize(("mode", "warns"), [(0o600, False), (0o640, True), (0o644, True)])
def test_a_file_of_passwords_that_others_may_read_is_told_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, mode: int, warns: bool
) -> None:
    (tmp_path / "users").write_text("actor:secret\n")
    (tmp_path / "users").chmod(mode)
    assert passwords.users(tmp_path / "users") == {"actor": "secret"}
    told = f"--password-file: {tmp_path}/users: others may read it; chmod 600 {tmp_path}/users"
    assert caplog.messages == ([told] if warns else [])


def test_a_password_is_shown_nowhere(tmp_path: Path) -> None:
    (tmp_path / "users").write_text("actor:secret\n")
    own = Security(password_file=str(tmp_path / "users"))
    assert "secret" not in f"{own} {own.words()} {own.peer('actor')!r}"


def test_certificates_make_tls_of_an_endpoint(certs: Path) -> None:
    """So that both sides need but one more option; what cannot be encrypted is refused."""
    own = Security(tls=str(certs))
    assert own.endpoint("tcp/far:7447") == own.endpoint("tls/far:7447") == "tls/far:7447"
    assert own.endpoint("quic/far:7447") == "quic/far:7447"
    for endpoint in ("unixsock-stream/a2s.sock", "ws/far:7447"):
        with pytest.raises(UsageError, match=f"found {endpoint} with --tls, expected tls/HOST"):
            own.endpoint(endpoint)
    with pytest.raises(UsageError, match=r"found tls/far:7447 without certificates, expected --tl"):
        Security().endpoint("tls/far:7447")
    with pytest.raises(UsageError, match="--password-file: found with --tls, expected one"):
        Security(tls="x", password_file="y")


@pytest.mark.parametrize(
    ("endpoint", "expected"),
    [
        ("tcp/127.0.0.1:7447", True), ("tcp/127.8.8.8:7447", True), ("tcp/localhost:7447", True),
        ("tcp/[::1]:7447", True), ("unixsock-stream/0.0.0.0/a2s.sock", True),
        ("tcp/0.0.0.0:7447", False), ("tcp/[::]:7447", False), ("tcp/10.0.0.1:7447", False),
        ("tcp/127.example:7447", False), ("tcp/localhost.example:7447", False),
    ],
)  # fmt: skip
def test_only_a_loopback_address_or_a_socket_of_this_machine_is_local(
    endpoint: str, expected: bool
) -> None:
    """Elsewhere nobody may listen who lets everybody in, unless that is what the user wants."""
    assert is_local(endpoint) is expected
    assert Security(insecure=True).listener(Keys("r"), endpoint).name == ""
    if not expected:
        with pytest.raises(UsageError, match=r"^--listen: found tcp/.*add --insecure"):
            Security().listener(Keys("r"), endpoint)

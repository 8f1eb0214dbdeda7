from __future__ import annotations

from pathlib import Path

import pytest

from companion.config_file import config_of
from companion.errors import ConfigError
from companion.web import security
from companion.web.security import COOKIE, SESSION_S, Asked, Gate, headers_of, read_token

TOKEN = "a-token-of-some-length"  # noqa: S105  of a test


def asked(method: str, path: str, **headers: str) -> Asked:
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return Asked(method, path, {"host": "127.0.0.1:8080", **named})


def status(gate: Gate, request: Asked, now_s: float = 0.0) -> int:
    refusal = gate.refusal(request, now_s)
    return 200 if refusal is None else refusal.status


@pytest.fixture
def open_gate() -> Gate:
    return Gate("127.0.0.1")


@pytest.fixture
def gate() -> Gate:
    return Gate("0.0.0.0", TOKEN)  # noqa: S104  what is tested


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:8080", "[::1]:8080", "LOCALHOST"])
def test_without_a_token_the_page_answers_to_this_computers_names(open_gate: Gate, host: str) -> None:
    assert status(open_gate, Asked("GET", "/api/state", {"host": host})) == 200


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8080", "127.0.0.1.evil.example", "", "a@b", "x/y"]
)
def test_and_to_no_other_so_that_a_name_cannot_be_turned_to_it(open_gate: Gate, host: str) -> None:
    assert status(open_gate, Asked("GET", "/", {"host": host})) == 421
    assert status(open_gate, Asked("GET", "/", {})) == 421


@pytest.mark.parametrize("method", ["POST", "DELETE", "PUT", "WEBSOCKET"])
def test_what_may_change_something_has_to_come_from_the_page_itself(open_gate: Gate, method: str) -> None:
    path = "/api/live" if method == "WEBSOCKET" else "/api/settings/apply"
    good = "http://127.0.0.1:8080"
    assert status(open_gate, asked(method, path, origin=good, sec_fetch_site="same-origin")) == 200
    assert status(open_gate, asked(method, path)) == 200  # a program, not a browser
    for origin in ("http://evil.example", "http://127.0.0.1:9999", "null", "file://", "http://127.0.0.1", ""):
        assert status(open_gate, asked(method, path, origin=origin)) == 403, origin
    assert status(open_gate, asked(method, path, sec_fetch_site="cross-site")) == 403
    assert status(open_gate, asked(method, path, sec_fetch_site="same-origin")) == 403
    assert status(open_gate, asked(method, path, cookie=f"{COOKIE}=1")) == 403


def test_another_page_cannot_read_either(open_gate: Gate) -> None:
    assert status(open_gate, asked("GET", "/api/picture.jpg", sec_fetch_site="cross-site")) == 403
    assert status(open_gate, asked("GET", "/api/picture.jpg", sec_fetch_site="same-site")) == 403
    assert status(open_gate, asked("GET", "/api/picture.jpg", sec_fetch_site="same-origin")) == 200


def test_with_a_token_all_but_the_pages_own_files_asks_for_it(gate: Gate) -> None:
    for path in ("/", "/static/main.js", "/api/session", "/api/login"):
        assert status(gate, asked("GET", path)) == 200
    for path in ("/api/state", "/api/settings", "/api/recordings", "/api/picture.jpg", "/api/anything"):
        assert status(gate, asked("GET", path)) == 401
    assert status(gate, asked("WEBSOCKET", "/api/live")) == 401
    assert status(gate, asked("GET", "/api/state", authorization=f"Bearer {TOKEN}")) == 200
    assert status(gate, asked("GET", "/api/state", authorization=f"bearer  {TOKEN} ")) == 200
    assert status(gate, asked("GET", "/api/state", authorization=f"Bearer {TOKEN}x")) == 403
    assert status(gate, asked("GET", "/api/state", authorization=f"Basic {TOKEN}")) == 401


def test_a_session_is_good_until_it_is_too_old_and_cannot_be_made_up(gate: Gate) -> None:
    session = gate.new_session(100.0)

    def with_cookie(value: str, now_s: float = 101.0) -> int:
        return status(gate, asked("GET", "/api/state", cookie=f"other=1; {COOKIE}={value}"), now_s)

    assert with_cookie(session) == 200
    assert with_cookie(session, 100.0 + SESSION_S) == 401
    expires, _, signature = session.partition(".")
    for forged in (
        f"{int(expires) + 9}.{signature}",
        f"{expires}.",
        "",
        "x.y",
        f"{expires}.{'0' * 64}",
        "9" * 500,
    ):
        assert with_cookie(forged) == 401
    assert with_cookie(Gate("0.0.0.0", TOKEN).new_session(100.0)) == 401  # noqa: S104  another server's


def test_wrong_tokens_are_counted(gate: Gate) -> None:
    answers = [gate.check_token("wrong", float(second)) for second in range(10)]
    assert [answer.status for answer in answers if answer is not None] == [403] * 8 + [429] * 2
    late = gate.check_token(TOKEN, 9.0)
    assert late is not None
    assert late.status == 429
    assert gate.check_token(TOKEN, 100.0) is None


def test_tokens_and_sessions_are_compared_in_constant_time(
    gate: Gate, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared: list[int] = []

    def compare(first: object, second: object) -> bool:
        compared.append(len(str(first)))
        return first == second

    monkeypatch.setattr(security.hmac, "compare_digest", compare)
    gate.check_token("x", 0.0)
    gate.check_token("x" * 300, 0.0)
    assert len(compared) == 2
    gate.refusal(asked("GET", "/api/state", cookie=f"{COOKIE}={gate.new_session(0.0)}"), 1.0)
    assert len(compared) == 3


def test_headers_that_come_twice_are_not_taken_for_one() -> None:
    raw = [(b"Host", b"127.0.0.1:8080"), (b"Host", b"evil.example")]
    assert Gate("127.0.0.1").refusal(Asked("GET", "/", headers_of(raw)), 0.0) is not None


def test_a_token_file_is_read_or_said_to_be_bad(tmp_path: Path) -> None:
    path = tmp_path / "token"
    assert read_token("") == ""
    path.write_text(f"{TOKEN}\nwhat follows is not read\n")
    path.chmod(0o600)
    assert read_token(str(path)) == TOKEN
    path.chmod(0o644)
    with pytest.raises(ConfigError, match="may be read by everybody"):
        read_token(str(path))
    path.chmod(0o600)
    path.write_text("short\n")
    with pytest.raises(ConfigError, match="5 characters; allowed: 16 or more"):
        read_token(str(path))
    with pytest.raises(ConfigError, match="cannot be read"):
        read_token(str(tmp_path / "none"))
    with pytest.raises(ConfigError, match=r"regular file|cannot be read"):
        read_token(str(tmp_path))


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.7", "::", "drone.local"])  # noqa: S104  what is tested
def test_another_address_needs_a_token_file(host: str) -> None:
    with pytest.raises(ConfigError, match=r"web\.host: found .*token_file"):
        config_of({"web": {"host": host}}, name="c")
    config_of({"web": {"host": host, "token_file": "token"}}, name="c")


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.9", "::1", "localhost"])
def test_this_computers_own_does_not(host: str) -> None:
    config_of({"web": {"host": host}}, name="c")

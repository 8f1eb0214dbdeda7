"""Who may ask for what: token and session, same origin, host names, limits; and the headers that every answer carries (pure).

Without a token the page is served to this computer alone, and only under its own names: a page of another origin cannot read
it by giving its own name our address (DNS rebinding). With one, everything but the page's own files asks for it.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
import stat
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from companion.errors import ConfigError

COOKIE: Final = "void_session"
SESSION_S: Final = 12 * 3600
SHORTEST_TOKEN: Final = 16
MAX_BODY_BYTES: Final = 64 * 1024
MAX_SOCKET_MESSAGE_BYTES: Final = 4096
_MAX_TOKEN_BYTES: Final = 1024
_MOST_FAILURES: Final = 8
_FAILURES_WITHIN_S: Final = 60.0
_OWN_NAMES: Final = frozenset({"localhost", "127.0.0.1", "::1"})
_READS: Final = frozenset({"GET", "HEAD"})

HEADERS: Final[Mapping[str, str]] = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        "manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}
"""No script, style or picture but ours, none inline, and nobody may put the page into a frame."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a request is not answered.

    Attributes
    ----------
    status
        Of HTTP.
    reason
        For people.
    """

    status: int
    reason: str


@dataclass(frozen=True, slots=True)
class Asked:
    """What of a request decides whether it is answered.

    Attributes
    ----------
    method
        Of HTTP; ``WEBSOCKET`` for a socket.
    path
        Without the query.
    headers
        By lower-case name; of one that comes twice, the values joined by a comma.
    """

    method: str
    path: str
    headers: Mapping[str, str]

    @property
    def writes(self) -> bool:
        """Whether it may change something, or opens a socket."""
        return self.method not in _READS


class Gate:
    """Decides which requests are answered.

    Parameters
    ----------
    host
        As the page is served at.
    token
        What the page asks for; "" for none.
    """

    def __init__(self, host: str, token: str = "") -> None:
        self._token = token.encode()
        self._names = _OWN_NAMES | {host.lower()}
        self._key = secrets.token_bytes(32)
        self._failures_s: deque[float] = deque(maxlen=_MOST_FAILURES)

    @property
    def needs_token(self) -> bool:
        """Whether a token is asked for."""
        return bool(self._token)

    def refusal(self, asked: Asked, now_s: float) -> Refusal | None:
        """Return why a request is not answered; None: it is.

        Parameters
        ----------
        asked
            The request.
        now_s
            Monotonic time.
        """
        headers = asked.headers
        host = headers.get("host", "")
        name = _host_name(host)
        if name is None or (not self.needs_token and name not in self._names):
            return Refusal(421, "asked under a name that is not this server's")
        if (refusal := _origin_refusal(asked, host)) is not None:
            return refusal
        is_open = not asked.path.startswith("/api/") or asked.path in ("/api/session", "/api/login")
        if is_open or not self.needs_token:
            return None
        if self._is_session(_cookie(headers.get("cookie", "")), now_s):
            return None
        scheme, _, credentials = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            return self.check_token(credentials.strip(), now_s)
        return Refusal(401, "the token is needed")

    def has_session(self, headers: Mapping[str, str], now_s: float) -> bool:
        """Return whether a request needs no token any more."""
        return not self.needs_token or self._is_session(_cookie(headers.get("cookie", "")), now_s)

    def check_token(self, given: str, now_s: float) -> Refusal | None:
        """Return why a token is not taken; the comparison takes as long for a wrong one as for the right one."""
        while self._failures_s and now_s - self._failures_s[0] > _FAILURES_WITHIN_S:
            self._failures_s.popleft()
        if len(self._failures_s) >= _MOST_FAILURES:
            return Refusal(429, "too many wrong tokens: wait a minute")
        if hmac.compare_digest(_digest(given.encode("utf-8", "surrogatepass")), _digest(self._token)):
            return None
        self._failures_s.append(now_s)
        return Refusal(403, "this is not the token")

    def new_session(self, now_s: float) -> str:
        """Return what a cookie holds for a viewer who knew the token; good until it is too old or the server ends."""
        expires = str(int(now_s + SESSION_S))
        return f"{expires}.{self._signature(expires)}"

    def _is_session(self, value: str, now_s: float) -> bool:
        expires, _, signature = value.partition(".")
        if not (expires.isascii() and expires.isdecimal() and len(expires) < 20 and signature.isascii()):
            return False
        return hmac.compare_digest(signature, self._signature(expires)) and now_s < int(expires)

    def _signature(self, expires: str) -> str:
        return hmac.new(self._key, expires.encode(), hashlib.sha256).hexdigest()


def read_token(path: str) -> str:
    """Read the token: the first line of a file that only its owner may read; "" for no file.

    Raises
    ------
    companion.errors.ConfigError
        When the file cannot be read, may be read by others, or holds no good token.
    """
    if not path:
        return ""
    try:
        with Path(path).open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            if not stat.S_ISREG(mode):
                raise ConfigError(f"web.token_file: {path}: must be a regular file")
            if mode & stat.S_IRWXO:
                raise ConfigError(f"web.token_file: {path}: may be read by everybody. Run: chmod 640 {path}")
            data = file.read(_MAX_TOKEN_BYTES)
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        raise ConfigError(f"web.token_file: {path}: cannot be read: {error}") from error
    token = data.partition(b"\n")[0].strip().decode("utf-8", "replace")
    if len(token) < SHORTEST_TOKEN:
        raise ConfigError(
            f"web.token_file: {path}: found a token of {len(token)} characters; allowed: {SHORTEST_TOKEN} or more. "
            f"Make one: (umask 077; openssl rand -hex 24 > {path})"
        )
    return token


def headers_of(raw: Iterable[tuple[bytes, bytes]]) -> dict[str, str]:
    """Return ASGI's headers by lower-case name."""
    headers: dict[str, str] = {}
    for name, value in raw:
        key, text = name.decode("latin-1").lower(), value.decode("latin-1")
        headers[key] = f"{headers[key]}, {text}" if key in headers else text
    return headers


def _origin_refusal(asked: Asked, host: str) -> Refusal | None:
    """Return why a request looks like another page's: a browser says where a request comes from, programs need not."""
    headers = asked.headers
    fetch_site = headers.get("sec-fetch-site", "")
    if asked.path.startswith("/api/") and fetch_site not in ("", "same-origin", "none"):
        return Refusal(403, "asked by a page of another origin")
    if not asked.writes:
        return None
    origin = headers.get("origin")
    if origin is None:
        if "cookie" in headers or fetch_site:
            return Refusal(403, "a browser's request to change something, without its origin")
        return None
    parts = urlsplit(origin)
    if parts.scheme not in ("http", "https") or parts.netloc.lower() != host.lower():
        return Refusal(403, "asked by a page of another origin")
    return None


def _host_name(host: str) -> str | None:
    """Return the name of a Host header without its port; None where there is no such name."""
    try:
        return urlsplit(f"//{host}").hostname if host and not set(host) & set("/\\@?#, ") else None
    except ValueError:
        return None


def _cookie(header: str) -> str:
    try:
        morsel = SimpleCookie(header).get(COOKIE)
    except CookieError:
        return ""
    return morsel.value if morsel is not None else ""


def _digest(secret: bytes) -> bytes:
    """Return a digest: of equal length whatever the secret's, so that not even that is told by the time taken."""
    return hashlib.sha256(secret).digest()

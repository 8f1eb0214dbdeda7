"""MAVLink 2 message signing: verify a setpoint's signature, and sign again what was rewritten.

A signature is 13 bytes behind the checksum: link id, 48-bit time stamp in 10 us since 2015, and the first 6 bytes of
SHA-256 over the key, the whole frame and the first two. https://mavlink.io/en/guide/message_signing.html
"""

from __future__ import annotations

import hashlib
import hmac
import os
import stat
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from companion.config import LinkConfig
from companion.errors import ConfigError
from companion.mavlink.framing import (
    CHECKSUM_BYTES,
    HEADER_V2,
    INCOMPAT_SIGNED,
    MAGIC_V2,
    SIGNATURE_BYTES,
    RawFrame,
    checksum,
)

KEY_BYTES: Final = 32
_HASH_BYTES: Final = 6
_STAMP: Final = slice(-12, -6)
_EPOCH_NS: Final = 1_420_070_400_000_000_000
"""2015-01-01 00:00 UTC, where the time stamps begin."""
_UNIT_NS: Final = 10_000
_NEW_STREAM_UNITS: Final = 6_000_000
"""A sender that was not heard yet may be this much behind our time: one minute."""
_MAX_STAMP: Final = (1 << 48) - 1
_MAX_FILE_BYTES: Final = 1024


def read_key(path: str | Path) -> bytes:
    """Read a signing key: 32 bytes as they are, or as 64 hexadecimal digits.

    Raises
    ------
    companion.errors.ConfigError
        When the file cannot be read, holds no key, or may be read by others than its owner.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            mode = os.fstat(
                file.fileno()
            ).st_mode  # of the file that is read, not of what is there a moment later
            if not stat.S_ISREG(mode):
                raise ConfigError(f"{path}: the signing key must be a regular file")
            if mode & (stat.S_IRWXG | stat.S_IRWXO):
                raise ConfigError(
                    f"{path}: the signing key may be used by others (mode {stat.S_IMODE(mode):04o}); allowed: its owner"
                    f" alone. Run: chmod 600 {path}"
                )
            data = file.read(_MAX_FILE_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot read the signing key: {error.strerror}") from error
    key = data if len(data) == KEY_BYTES else _from_hex(data)
    if key is None:
        raise ConfigError(
            f"{path}: found {min(len(data), _MAX_FILE_BYTES)} bytes; allowed: a signing key of 32 bytes, or of 64"
            " hexadecimal digits"
        )
    if not any(key):
        raise ConfigError(f"{path}: a signing key of zeros means no signing; allowed: any other")
    return key


def open_signatures(config: LinkConfig) -> Signatures | None:
    """Return what verifies and signs with the configured key; None without one.

    Raises
    ------
    companion.errors.ConfigError
        When the key cannot be used.
    """
    if not config.signing_key_file:
        return None
    return Signatures(read_key(config.signing_key_file), link_id=config.signing_link_id)


def _from_hex(data: bytes) -> bytes | None:
    try:
        key = bytes.fromhex(data.decode("ascii").strip())
    except ValueError:
        return None
    return key if len(key) == KEY_BYTES else None


class Signatures:
    """Verifies signatures made with one key, and signs with it as a link of its own.

    Parameters
    ----------
    key
        32 bytes, shared by planner, companion and autopilot.
    link_id
        Ours, 0 to 255: a receiver keeps the newest time stamp of each sender and link, so no other link of the
        network may use it.
    unix_ns
        Wall-clock time. Where it is behind (no clock chip), the newest time stamp seen is used instead.

    Raises
    ------
    ValueError
        When key or link id are not of their size.
    """

    def __init__(self, key: bytes, *, link_id: int, unix_ns: Callable[[], int] = time.time_ns) -> None:
        if len(key) != KEY_BYTES:
            raise ValueError(f"expected a key of {KEY_BYTES} bytes, got {len(key)}")
        if not 0 <= link_id <= 255:
            raise ValueError(f"expected a link id from 0 to 255, got {link_id}")
        self._key = key
        self._link_id = link_id
        self._unix_ns = unix_ns
        self._newest = 0
        self._streams: dict[tuple[int, int, int], int] = {}

    def __repr__(self) -> str:
        return f"Signatures(link_id={self._link_id})"  # a key is not for logs

    def verify(self, frame: RawFrame) -> str | None:
        """Return why a frame's signature is not accepted, or None where it is.

        Nothing is stored of a frame that is not: a forged time stamp of the future would block genuine frames.
        """
        if not frame.is_signed:
            return "not signed"
        data = frame.data
        if not hmac.compare_digest(self._hash(data[:-_HASH_BYTES]), data[-_HASH_BYTES:]):
            return "wrong signature"
        stamp = int.from_bytes(data[_STAMP], "little")
        stream = (data[-SIGNATURE_BYTES], frame.system_id, frame.component_id)
        last = self._streams.get(stream)
        if last is not None and stamp <= last:
            return "replayed"
        if last is None and stamp + _NEW_STREAM_UNITS < self._now():
            return "too old"
        self._streams[stream] = stamp
        self._newest = max(self._newest, stamp)
        return None

    def sign(self, data: bytes, *, other_link_id: int | None = None) -> bytes:
        """Return an unsigned MAVLink 2 frame with our signature; its checksum is renewed.

        Parameters
        ----------
        data
            A whole frame of a known message.
        other_link_id
            The link id that the frame's own sender signs with, where there is one: ours is then another, so that what
            passes untouched from that sender is not taken for a replay.

        Raises
        ------
        ValueError
            When the frame is MAVLink 1 or carries incompatibility flags.
        """
        if data[0] != MAGIC_V2 or data[2]:
            raise ValueError("only a MAVLink 2 frame without incompatibility flags can be signed")
        body = data[1:2] + bytes([INCOMPAT_SIGNED]) + data[3:-CHECKSUM_BYTES]
        message_id = int.from_bytes(data[HEADER_V2 - 3 : HEADER_V2], "little")
        crc = checksum(body, message_id).to_bytes(CHECKSUM_BYTES, "little")
        stamp = min(max(self._now(), self._newest + 1), _MAX_STAMP)
        self._newest = stamp
        link_id = self._link_id if self._link_id != other_link_id else (self._link_id + 1) % 256
        signed = data[:1] + body + crc + bytes([link_id]) + stamp.to_bytes(6, "little")
        return signed + self._hash(signed)

    def _now(self) -> int:
        return max((self._unix_ns() - _EPOCH_NS) // _UNIT_NS, self._newest)

    def _hash(self, covered: bytes) -> bytes:
        return hashlib.sha256(self._key + covered).digest()[:_HASH_BYTES]


def link_id_of(frame: RawFrame) -> int:
    """Return the link id of a signed frame."""
    return frame.data[-SIGNATURE_BYTES]


def without_signature(frame: RawFrame) -> RawFrame:
    """Return a signed frame of a known message as it would be unsigned: flag cleared, checksum renewed.

    Raises
    ------
    ValueError
        When the frame is not signed, or carries other incompatibility flags too.
    """
    if frame.incompat_flags != INCOMPAT_SIGNED:
        raise ValueError(f"incompatibility flags {frame.incompat_flags:#x}, expected the one of a signature")
    data = frame.data
    body = data[1:2] + b"\0" + data[3 : -SIGNATURE_BYTES - CHECKSUM_BYTES]
    crc = checksum(body, frame.message_id).to_bytes(CHECKSUM_BYTES, "little")
    return frame._replace(data=data[:1] + body + crc)

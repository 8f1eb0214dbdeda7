"""The page as served: over loopback, by real clients."""

from __future__ import annotations

import contextlib
import gzip
import http.client
import json
import re
import socket
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from companion.io.messages import Kind
from companion.web.assets import load_assets
from companion.web.security import MAX_BODY_BYTES, MAX_SOCKET_MESSAGE_BYTES
from tests.companion.web.conftest import Served
from tests.companion.web.showcase import Looked, Showcase

PATIENCE_S = 40.0
FIRST_LOAD_BYTES = 500_000

Serve = Callable[..., Served]


def ask(
    served: Served, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None
) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", served.port, timeout=PATIENCE_S)
    try:
        data = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
        sent = {"Content-Type": "application/json"} if method == "POST" else {}
        connection.request(method, path, body=data, headers={**sent, **(headers or {})})
        answer = connection.getresponse()
        return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
    finally:
        connection.close()


def ask_json(served: Served, method: str, path: str, body: Any = None) -> Any:
    status, _, data = ask(served, method, path, body)
    assert status in (200, 201), data
    return json.loads(data)


def look(served: Served, **options: Any) -> ClientConnection:
    return connect(f"ws://127.0.0.1:{served.port}/api/live", open_timeout=PATIENCE_S, **options)


def picture_of(data: bytes) -> tuple[dict[str, Any], np.ndarray]:
    (length,) = struct.unpack_from("<I", data)
    image = cv2.imdecode(np.frombuffer(data[4 + length :], np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return json.loads(data[4 : 4 + length]), image


def drain(viewer: ClientConnection) -> None:
    """Read until the server ends it."""
    while True:
        viewer.recv(PATIENCE_S)


def wait_until(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, "it never came"
        time.sleep(0.02)


# ---------------------------------------------------------------------- what is served


def test_the_page_and_all_that_it_names_is_served_and_small(serve: Serve) -> None:
    served = serve()
    status, headers, page = ask(served, "GET", "/")
    assert status == 200
    assert headers["content-type"] == "text/html; charset=utf-8"
    wanted, found = set(re.findall(r'(?:src|href)="(/[^"]+)"', page.decode())), {"/": page}
    while wanted - found.keys():
        path = (wanted - found.keys()).pop()
        status, headers, data = ask(served, "GET", path)
        assert status == 200, path
        assert headers["x-content-type-options"] == "nosniff"
        found[path] = data
        if path.endswith(".js"):
            wanted |= {f"/static/{name}" for name in re.findall(r'from "\./([a-z.]+)"', data.decode())}
    assert {"/static/style.css", "/static/main.js", "/static/scene.js", "/static/settings.js"} <= found.keys()
    assert sum(map(len, found.values())) <= FIRST_LOAD_BYTES
    for path, data in found.items():
        assert not re.search(rb"https?://(?!www\.w3\.org/2000/svg)", data), f"{path} needs a network"


def test_files_are_packed_and_asked_for_again_only_when_they_have_changed(serve: Serve) -> None:
    served = serve()
    _, headers, packed = ask(served, "GET", "/static/style.css", headers={"Accept-Encoding": "gzip"})
    assert headers["content-encoding"] == "gzip"
    assert gzip.decompress(packed) == load_assets()["style.css"].data
    etag = headers["etag"]
    assert ask(served, "GET", "/static/style.css", headers={"If-None-Match": etag})[0] == 304


@pytest.mark.parametrize(
    "path",
    [
        "/static/../sink.py",
        "/static/..%2fsink.py",
        "/static/%2e%2e/sink.py",
        "/static/%2fetc%2fpasswd",
        "/static//etc/passwd",
        "/static/__init__.py",
        "/api/recordings/..%2f..%2fetc",
        "/api/recordings/%2fetc%2fpasswd",
        "/api/recordings/../../etc/passwd",
        "/api/recordings/office_walk/pictures/0.jpg",
        "/api/recordings/%00/pictures/0.jpg",
    ],
)
def test_no_name_leads_out_of_what_is_served(serve: Serve, path: str) -> None:
    status, _, data = ask(serve(), "GET", path)
    assert status in (404, 409), data
    assert set(json.loads(data)) == {"error"} if status == 409 else True


def test_every_answer_carries_the_headers_that_keep_others_out(serve: Serve) -> None:
    served = serve()
    for path in ("/", "/static/main.js", "/api/session", "/api/nothing", "/api/recordings/none"):
        _, headers, _ = ask(served, "GET", path)
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert "frame-ancestors 'none'" in policy
        assert headers["x-frame-options"] == "DENY"
        assert headers["cross-origin-resource-policy"] == "same-origin"
        assert "access-control-allow-origin" not in headers
    page = load_assets()["index.html"].data.decode()
    assert not re.search(r"<script(?![^>]* src=)|<style|\son[a-z]+=|\sstyle=|javascript:", page)


# ---------------------------------------------------------------------- who may ask


def test_requests_of_other_pages_are_refused_at_the_door(serve: Serve) -> None:
    served = serve()
    values = {"values": {"guidance.max_step_m": 1.0}}
    evil = {"Origin": "http://evil.example"}
    assert ask(served, "POST", "/api/settings/apply", values, evil)[0] == 403
    assert ask(served, "POST", "/api/settings/undo", {}, evil)[0] == 403
    assert ask(served, "DELETE", "/api/comparisons/1", headers=evil)[0] == 403
    assert ask(served, "GET", "/api/state", headers={"Host": "evil.example"})[0] == 421
    with pytest.raises(InvalidStatus) as refused, look(served, origin="http://evil.example"):
        pass
    assert refused.value.response.status_code == 403
    form = {"Content-Type": "text/plain"}  # what a form of another page could send without being asked
    assert ask(served, "POST", "/api/settings/apply", values, form)[0] == 415
    assert not served.desk.asked


def test_with_a_token_the_page_asks_for_it(serve: Serve, tmp_path: Path) -> None:
    token_file = tmp_path / "token"
    token_file.write_text("correct-horse-battery\n")
    token_file.chmod(0o600)
    served = serve(token_file=str(token_file))
    assert ask(served, "GET", "/")[0] == 200
    assert ask_json(served, "GET", "/api/session")["token_needed"] is True
    assert ask(served, "GET", "/api/state")[0] == 401
    with pytest.raises(InvalidStatus) as refused, look(served):
        pass
    assert refused.value.response.status_code == 401
    assert ask(served, "POST", "/api/login", {"token": "wrong"})[0] == 403
    assert ask(served, "POST", "/api/login", {"token": 5})[0] == 400
    status, headers, _ = ask(served, "POST", "/api/login", {"token": "correct-horse-battery"})
    assert status == 200
    cookie = headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "samesite=strict" in cookie.lower()
    session = {"Cookie": cookie.partition(";")[0]}
    assert ask(served, "GET", "/api/state", headers=session)[0] == 200
    own = f"http://127.0.0.1:{served.port}"
    assert ask(served, "POST", "/api/settings/undo", {}, {**session, "Origin": own})[0] == 200
    assert ask(served, "POST", "/api/settings/undo", {}, session)[0] == 403
    with look(served, additional_headers={**session}, origin=own) as viewer:
        assert json.loads(viewer.recv(PATIENCE_S))["type"] == "snapshot"
    bearer = {"Authorization": "Bearer correct-horse-battery"}
    assert ask(served, "GET", "/api/settings", headers=bearer)[0] == 200


def test_no_route_arms_changes_the_mode_or_moves_the_vehicle(flying: Served) -> None:
    served = flying
    for path in (
        "arm",
        "disarm",
        "mode",
        "takeoff",
        "land",
        "goto",
        "setpoint",
        "command",
        "engage",
        "record",
    ):
        for method in ("GET", "POST", "PUT"):
            assert ask(served, method, f"/api/{path}", {} if method != "GET" else None)[0] in (404, 405, 415)
    for key in ("engagement.by", "web.token_file", "link.signing_key_file", "source.url", "status.socket"):
        applied = ask_json(served, "POST", "/api/settings/apply", {"values": {key: "x"}})
        assert applied["accepted"] is False
        assert key in applied["refused"]
    with look(served) as viewer:
        viewer.send(json.dumps({"type": "command", "name": "arm"}))
        with pytest.raises(ConnectionClosed):
            drain(viewer)
    assert served.desk.asked == []


# ---------------------------------------------------------------------- limits


def test_too_much_is_refused(serve: Serve) -> None:
    served = serve()
    long = json.dumps({"values": {"guidance.max_step_m": 1.0, "x": "y" * MAX_BODY_BYTES}}).encode()
    assert ask(served, "POST", "/api/settings/apply", long)[0] == 413
    chunked = {"Transfer-Encoding": "chunked"}
    chunks = (
        b"".join(b"%x\r\n%s\r\n" % (len(part), part) for part in (long[:40_000], long[40_000:]))
        + b"0\r\n\r\n"
    )
    assert ask(served, "POST", "/api/settings/apply", chunks, chunked)[0] == 413
    assert ask(served, "POST", "/api/settings/apply", b"{" * 10)[0] == 400
    assert ask(served, "POST", "/api/settings/apply", b"[" * 50_000)[0] == 400
    with contextlib.suppress(ConnectionError):  # it need not wait for the end of such a line to answer
        assert ask(served, "GET", "/" + "x" * 1_000_000)[0] == 400
    with look(served) as viewer:
        viewer.send("x" * (MAX_SOCKET_MESSAGE_BYTES + 1))
        with pytest.raises(ConnectionClosed) as closed:
            drain(viewer)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1009
    assert not served.desk.asked


def test_a_viewer_too_many_is_told_so_and_the_others_stay(serve: Serve) -> None:
    served = serve(max_clients=2)
    with look(served) as first, look(served) as second:
        for viewer in (first, second):
            assert json.loads(viewer.recv(PATIENCE_S))["type"] == "snapshot"
        with look(served) as third, pytest.raises(ConnectionClosed) as closed:
            third.recv(PATIENCE_S)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 4001
        assert "2 are looking" in closed.value.rcvd.reason
        first.send(json.dumps({"type": "shown"}))
    wait_until(lambda: Kind.POSE not in served.desk.wants.kinds)


@pytest.mark.parametrize("said", ["no json", "[]", "5", '{"type": "want"}', "", b"\x00\x01"])
def test_what_a_viewer_says_is_understood_or_ends_it(serve: Serve, said: str | bytes) -> None:
    served = serve()
    with look(served) as viewer:
        viewer.send(said)
        with pytest.raises(ConnectionClosed):
            drain(viewer)
    assert ask(served, "GET", "/api/session")[0] == 200


# ---------------------------------------------------------------------- the live part


def test_a_viewer_sees_pictures_and_state_and_nothing_is_asked_for_when_nobody_looks(flying: Served) -> None:
    desk = flying.desk
    assert Kind.FRAME not in desk.wants.kinds
    with look(flying) as viewer:
        message = json.loads(viewer.recv(PATIENCE_S))
        assert message["type"] == "snapshot"
        assert message["latest"]["switch"]["state"] == "STEER"
        seen: dict[str, Any] = {}
        numbers: list[int] = []
        wait_until(lambda: {Kind.FRAME, Kind.POSE, Kind.DETAILS} <= desk.wants.kinds)
        assert desk.wants.frames_hz == 15.0
        while len(numbers) < 5 or not {"pose", "detection", "details", "setpoint"} <= seen.keys():
            got = viewer.recv(PATIENCE_S)
            if isinstance(got, bytes):
                header, image = picture_of(got)
                assert image.shape == (header["height_px"], header["width_px"]) == (360, 540)
                numbers.append(header["seq"])
                viewer.send(json.dumps({"type": "shown"}))
            else:
                seen.update(json.loads(got)["latest"])
        assert numbers == sorted(numbers)
        assert seen["detection"]["kind"] == "gap"
        assert len(seen["details"]["map"]) > 5
        assert ask(flying, "GET", "/api/picture.jpg")[2][:2] == b"\xff\xd8"
        assert "pose" in ask_json(flying, "GET", "/api/state")["latest"]
        viewer.send(json.dumps({"type": "want", "pictures": False, "details": False}))
        wait_until(
            lambda: not {Kind.FRAME, Kind.DETAILS} & desk.wants.kinds and Kind.POSE in desk.wants.kinds
        )
    wait_until(lambda: Kind.POSE not in desk.wants.kinds)


def test_viewers_that_take_nothing_cost_the_others_nothing(serve: Serve, looked: list[Looked]) -> None:
    served = serve()
    stalled = [socket.create_connection(("127.0.0.1", served.port)) for _ in range(3)]
    for one in stalled:  # it opens a socket and never reads a byte of it again
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        one.sendall(
            b"GET /api/live HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
            b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
        )
    try:
        wait_until(lambda: ask_json(served, "GET", "/api/state")["latest"].get("viewers") == 3)
        with Showcase(served.page, served.desk, looked, rate_hz=60.0), look(served) as viewer:
            pictures = 0
            while pictures < 60:
                if isinstance(viewer.recv(PATIENCE_S), bytes):
                    pictures += 1
                    viewer.send(json.dumps({"type": "shown"}))
    finally:
        for one in stalled:
            one.close()


def test_an_address_that_is_taken_is_said_once_and_tried_again(serve: Serve) -> None:
    first = serve()
    second = serve(port=first.port)
    second.page.idle()
    second.page.idle()
    assert [event for event, _ in second.desk.lines] == ["web_not_served"]
    first.page.stop()
    wait_until(lambda: second.page.idle() is None and "web_serving" in dict(second.desk.lines))
    assert ask(first, "GET", "/api/session")[0] == 200  # the second one, at the first one's port

"""The status socket: who may open it, what it answers, and that no client can slow or stop what serves it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import select
import socket
import stat
import threading
import time

import pytest
from structlog import wrap_logger
from structlog.testing import CapturingLogger

from companion.config import StatusConfig
from companion.errors import ConfigError
from companion.status import server as server_module
from companion.status.client import NoAnswerError, NotRunningError, StatusClient, ask
from companion.status.protocol import ProtocolError, Request, pack_request, unpack_answer, unpack_request
from companion.status.server import MOST_CLIENTS, StatusServer
from companion.status.unix_socket import StatusError, open_listener, runtime_folder, socket_path

DEADLINE_S = 30.0


async def until(condition) -> None:
    end_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < end_s, "did not come"
        await asyncio.sleep(0.01)


class Bench:
    """A server at a socket, in the loop of the test."""

    def __init__(self, folder, *, snapshot=None) -> None:
        self.path = folder / "status.sock"
        self.commands = {}
        captured = CapturingLogger()
        self.calls = captured.calls

        def as_call(logger, method, event):
            return (event.pop("event"),), event

        async def good():
            return {"state": "FOLLOW", "age_ms": float("nan")}

        self.server = StatusServer(
            self.path,
            snapshot=snapshot or good,
            commands=self.commands,
            log=wrap_logger(captured, processors=[as_call]).bind(),
        )

    def events(self, name: str) -> list[dict]:
        return [call.kwargs for call in self.calls if call.args == (name,)]

    @contextlib.asynccontextmanager
    async def running(self):
        task = asyncio.create_task(self.server.run())
        try:
            await until(lambda: self.events("status_socket_open") or self.events("status_socket_failed"))
            yield task
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    async def ask(self, command: str = "status", arguments=None) -> dict:
        return await asyncio.to_thread(ask, self.path, command, arguments)


async def test_status_is_answered_and_what_json_does_not_know_is_null(tmp_path):
    bench = Bench(tmp_path)
    async with bench.running():
        assert await bench.ask() == {"state": "FOLLOW", "age_ms": None}
    assert not bench.path.exists()


async def test_the_socket_is_for_its_user_and_group_only(tmp_path):
    bench = Bench(tmp_path)
    async with bench.running():
        assert stat.S_IMODE(bench.path.stat().st_mode) == 0o660
        assert [path.name for path in tmp_path.iterdir()] == ["status.sock"]


async def test_commands_are_obeyed_refused_and_failing_ones_reported(tmp_path):
    bench = Bench(tmp_path)

    def refuse(arguments):
        raise ConfigError("the disk is full")

    def fail(arguments):
        raise RuntimeError("a fault of ours")

    async with bench.running():
        bench.commands.update(
            {"record-start": lambda arguments: {"file": arguments["name"]}, "refuse": refuse, "fail": fail}
        )
        assert await bench.ask("record-start", {"name": "a.mcap"}) == {"file": "a.mcap"}
        with pytest.raises(ProtocolError, match="the disk is full"):
            await bench.ask("refuse")
        with pytest.raises(ProtocolError, match="a fault of ours"):
            await bench.ask("fail")
        with pytest.raises(
            ProtocolError, match="unknown command 'x'; known: fail, record-start, refuse, status"
        ):
            await bench.ask("x")
        assert (await bench.ask())["state"] == "FOLLOW"
    assert bench.events("status_command") == [
        {"command": "record-start"},
        {"command": "refuse", "refused": "the disk is full"},
    ]
    assert [event["command"] for event in bench.events("status_command_failed")] == ["fail"]


@pytest.mark.parametrize(
    ("line", "error"),
    [
        (b"status\n", "not JSON"),
        (b"[1]\n", "not a JSON object"),
        (b'{"command": 3}\n', "not a request"),
        (b'{"command": "status", "arguments": []}\n', "not a request"),
        (b'{"command": "status", "x": 1}\n', "not a request"),
        (b"\xff\xfe\n", "not JSON"),
        (b"[" * 4000 + b"\n", "not JSON"),
    ],
)
async def test_what_is_no_request_is_answered_with_why_and_the_connection_goes_on(tmp_path, line, error):
    bench = Bench(tmp_path)
    async with bench.running():
        reader, writer = await asyncio.open_unix_connection(bench.path)
        writer.write(line)
        packet = json.loads(await asyncio.wait_for(reader.readline(), DEADLINE_S))
        assert packet["ok"] is False
        assert error in packet["error"]
        writer.write(pack_request(Request("status")))
        assert unpack_answer(await asyncio.wait_for(reader.readline(), DEADLINE_S))["state"] == "FOLLOW"
        writer.close()


async def test_a_line_without_end_is_hung_up_on(tmp_path):
    bench = Bench(tmp_path)
    async with bench.running():
        reader, writer = await asyncio.open_unix_connection(bench.path)
        writer.write(b"x" * 100_000)
        with contextlib.suppress(ConnectionError):
            assert await asyncio.wait_for(reader.read(), DEADLINE_S) == b""
        writer.close()
        assert (await bench.ask())["state"] == "FOLLOW"


async def test_only_so_many_clients_at_once_and_one_that_leaves_makes_room(tmp_path):
    bench = Bench(tmp_path)
    async with bench.running():
        held = [await asyncio.open_unix_connection(bench.path) for _ in range(MOST_CLIENTS)]
        for reader, writer in held:
            writer.write(pack_request(Request("status")))
            await asyncio.wait_for(reader.readline(), DEADLINE_S)
        with pytest.raises((ProtocolError, NotRunningError)):
            await bench.ask()
        held[0][1].close()

        async def has_room() -> bool:
            with contextlib.suppress(ProtocolError, NotRunningError):
                return bool(await bench.ask())
            return False

        end_s = time.monotonic() + DEADLINE_S
        while not await has_room():
            assert time.monotonic() < end_s
        for _, writer in held[1:]:
            writer.close()


async def test_a_client_that_never_reads_is_hung_up_on_and_others_are_served(tmp_path, monkeypatch):
    monkeypatch.setattr(server_module, "_STALLED_S", 0.2)
    monkeypatch.setattr(server_module, "_SPACING_S", 0.0)

    async def large():
        return {"text": "x" * 200_000}

    bench = Bench(tmp_path, snapshot=large)
    async with bench.running():
        stalled = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        with stalled:
            stalled.connect(str(bench.path))
            stalled.settimeout(DEADLINE_S)
            stalled.sendall(pack_request(Request("status")) * 20)
            assert len((await bench.ask())["text"]) == 200_000  # while the other one still stalls
            poll = select.poll()
            poll.register(stalled, select.POLLHUP)
            assert await asyncio.to_thread(poll.poll, 1000 * DEADLINE_S), "it was not hung up on"
            assert await asyncio.to_thread(_read_to_the_end, stalled) < 20 * 200_000


def _read_to_the_end(sock: socket.socket) -> int:
    total = 0
    with contextlib.suppress(ConnectionError):
        while data := sock.recv(1 << 20):
            total += len(data)
    return total


async def test_a_client_that_asks_without_end_takes_turns_with_the_loop(tmp_path, monkeypatch):
    monkeypatch.setattr(server_module, "_SPACING_S", 0.05)
    bench = Bench(tmp_path)
    async with bench.running():
        reader, writer = await asyncio.open_unix_connection(bench.path)
        begin_s = time.monotonic()
        writer.write(pack_request(Request("status")) * 20)
        for _ in range(20):
            await asyncio.wait_for(reader.readline(), DEADLINE_S)
        assert time.monotonic() - begin_s > 18 * 0.05  # the pauses between its requests are kept
        writer.close()


async def test_the_end_of_the_service_hangs_up_on_clients_and_is_no_failure(tmp_path, caplog):
    bench = Bench(tmp_path)
    async with bench.running():
        reader, writer = await asyncio.open_unix_connection(bench.path)
        writer.write(pack_request(Request("status")))
        await asyncio.wait_for(reader.readline(), DEADLINE_S)
    assert await asyncio.wait_for(reader.read(), DEADLINE_S) == b""
    writer.close()
    assert caplog.records == []
    assert bench.events("status_failed") == []


async def test_a_fault_in_the_snapshot_is_logged_once_and_ends_nothing(tmp_path):
    async def broken():
        raise ZeroDivisionError

    bench = Bench(tmp_path, snapshot=broken)
    async with bench.running() as task:
        for _ in range(3):
            with pytest.raises(NotRunningError):
                await bench.ask()
        assert not task.done()
    assert len(bench.events("status_failed")) == 1


# ---------------------------------------------------------------- the socket as a file


def test_a_socket_that_was_left_behind_is_replaced(tmp_path):
    path = tmp_path / "status.sock"
    with open_listener(path):
        pass
    assert path.exists()
    with pytest.raises(NotRunningError, match="nobody listens at"):
        StatusClient(path)
    with open_listener(path), StatusClient(path):
        pass


def test_what_somebody_answers_at_or_what_is_no_socket_is_left_alone(tmp_path):
    path = tmp_path / "status.sock"
    with open_listener(path), pytest.raises(StatusError, match="another process answers there"):
        open_listener(path)
    file = tmp_path / "notes.txt"
    file.write_text("mine")
    with pytest.raises(StatusError, match="is no socket"):
        open_listener(file)
    assert file.read_text() == "mine"


@pytest.mark.parametrize("name", ["nowhere/status.sock", "x" * 200, "a\0b"])
def test_a_place_that_cannot_be_used_is_one_clear_line(tmp_path, name):
    with pytest.raises(StatusError, match="cannot be made") as caught:
        open_listener(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


async def test_a_place_that_cannot_be_used_is_announced_once_and_tried_again(tmp_path, monkeypatch):
    monkeypatch.setattr(server_module, "_RETRY_S", 0.01)
    bench = Bench(tmp_path / "later")
    async with bench.running():
        await asyncio.sleep(0.1)
        assert len(bench.events("status_socket_failed")) == 1
        (tmp_path / "later").mkdir()
        await until(lambda: bench.events("status_socket_open"))
        assert (await bench.ask())["state"] == "FOLLOW"


def test_a_client_is_told_what_is_wrong(tmp_path):
    with pytest.raises(NotRunningError, match="not running: there is no socket"):
        ask(tmp_path / "none.sock", "status")
    silent = tmp_path / "silent.sock"
    with (
        open_listener(silent),
        StatusClient(silent, timeout_s=0.05) as client,
        pytest.raises(NoAnswerError, match=r"no answer within 0.05 s: .* hangs"),
    ):
        client.ask("status")
    leaving = tmp_path / "leaving.sock"
    with open_listener(leaving) as listener:
        listener.settimeout(DEADLINE_S)

        def leave() -> None:
            listener.accept()[0].close()

        thread = threading.Thread(target=leave)
        thread.start()
        with pytest.raises(NotRunningError, match="the service has ended"):
            ask(leaving, "status")
        thread.join()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open every socket")
def test_a_client_that_may_not_is_told_how_it_could(tmp_path):
    path = tmp_path / "status.sock"
    with open_listener(path):
        path.chmod(0)
        with pytest.raises(StatusError, match="join the group void-companion"):
            ask(path, "status")


def test_where_the_socket_belongs(tmp_path):
    assert socket_path(StatusConfig(), None) is None
    assert socket_path(StatusConfig(), tmp_path) == tmp_path / "status.sock"
    assert socket_path(StatusConfig(socket="/run/x.sock"), tmp_path).as_posix() == "/run/x.sock"
    assert runtime_folder({"RUNTIME_DIRECTORY": "/run/a:/run/b"}).as_posix() == "/run/a"
    assert runtime_folder({}) is None


def test_requests_and_answers_read_back():
    request = Request("record-start", {"name": "a"})
    assert unpack_request(pack_request(request)) == request
    assert unpack_request(b'{"command": "status"}') == Request("status")
    with pytest.raises(ProtocolError, match="not an answer"):
        unpack_answer(b'{"ok": true, "answer": 3}')

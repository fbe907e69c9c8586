"""The server of the page and its command line: who is let in, what malformed messages get, and what stays behind."""

import contextlib
import gc
import json
import re
import socket
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
import tyro
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from baselines import OpenLoop
from baselines.registry import configure
from cfp.play import __main__ as program
from cfp.play.protocol import HEAD
from cfp.play.server import LARGEST_NUMBER, Pace, Server
from cfp.play.session import Session
from cfp.policy import describe_run

SMALL: dict[str, Any] = {"particles": 200, "substeps": 10}
run = partial(Session, "run", **SMALL)
MALFORMED = ["", "null", '{"type": "play"}', '{"type": "policy", "name": "../../etc/passwd"}']


@contextlib.contextmanager
def serve(root_path: str = "", new_session: Callable[[], Session] = run) -> Iterator[Server]:
    """A server on a free port, in a thread."""
    server = Server(new_session, "secret", port=0, root_path=root_path)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        yield server
    finally:
        server.stop()
        thread.join(10)
    assert not thread.is_alive()


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    """A server; the kernels are compiled before pages wait for pictures."""
    run().advance()
    with serve() as server:
        yield server


def open_page(server: Server) -> ClientConnection:
    """A WebSocket as the page opens it."""
    host = f"127.0.0.1:{server.port}"
    return connect(f"ws://{host}/ws?token=secret", origin=f"http://{host}", proxy=None)  # type: ignore[arg-type]


def receive(page: ClientConnection, wanted: str) -> Any:
    """The next message of a type, or of a frame the number of its step; frames on the way are acknowledged."""
    while True:
        content = page.recv(timeout=600)
        if isinstance(content, bytes):
            number, step, *_ = HEAD.unpack_from(content)
            page.send(json.dumps({"type": "seen", "frame": number}))
            if wanted == "frame":
                return step
        elif (message := json.loads(content))["type"] == wanted:
            return message


def tell(page: ClientConnection, kind: str, **fields: Any) -> None:
    page.send(json.dumps({"type": kind, **fields}))


def status(server: Server, path: str, host: str | None = None) -> tuple[int, str, Any]:
    request = urllib.request.Request(f"http://127.0.0.1:{server.port}{path}", headers={"Host": host} if host else {})
    try:
        with urllib.request.urlopen(request) as answer:
            return answer.status, answer.read().decode(), answer.headers
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode(), error.headers


def test_page_and_its_files(server: Server) -> None:
    code, page, headers = status(server, "/?token=secret")
    assert code == 200 and "default-src 'self'" in headers["content-security-policy"]
    assert "http" not in page  # nothing comes from elsewhere
    code, _, headers = status(server, "/page/main.js")
    assert code == 200 and headers["cache-control"] == "no-store"
    assert status(server, "/page/../server.py")[0] == 404


@pytest.mark.parametrize(
    ("root_path", "host", "origin", "stranger"),
    [
        ("", "localhost:8000", "http://localhost:8000", "http://localhost:1"),
        ("https://Hub.example.org/user/me", "hub.example.org", "https://hub.example.org", "http://hub.example.org"),
        ("https://hub.example.org/user/me/", "127.0.0.1:8000", "https://hub.example.org", "http://127.0.0.1:8000"),
        ("/user/me", "127.0.0.1:9000", "http://127.0.0.1:9000", "https://hub.example.org"),
    ],
    ids=["no proxy", "whole address", "host not passed on", "path alone"],
)
def test_its_own_page_is_let_in_with_the_token(root_path: str, host: str, origin: str, stranger: str) -> None:
    """Also behind a proxy, which may take the path away."""
    with serve(root_path) as server, contextlib.ExitStack() as stack:

        def open_page(prefix: str, token: str, origin: str | None) -> ClientConnection:
            stream = stack.enter_context(socket.create_connection(("127.0.0.1", server.port)))
            return connect(f"ws://{host}{prefix}/ws?token={token}", sock=stream, origin=origin, proxy=None)  # type: ignore[arg-type]

        for prefix in sorted({"", server.prefix}):
            for path, code in (("/?token=secret", 200), ("/page/main.js", 200), ("/?token=guess", 403), ("/", 403)):
                assert status(server, prefix + path, host)[0] == code
            assert status(server, f"{prefix}/?token=secret", "example.com")[0] == 400
            refused = [("secret", source) for source in (stranger, "null", None)]
            for token, source in (("", origin), ("guess", origin), *refused):
                with pytest.raises(InvalidStatus, match="403"):
                    open_page(prefix, token, source)
            with open_page(prefix, "secret", origin) as page:
                assert receive(page, "hello")["task"] == "run"
        start = "https://hub.example.org" if server.proxy else f"http://127.0.0.1:{server.port}"
        assert server.address == f"{start}{server.prefix}/?token=secret"


def test_malformed_messages_are_answered_and_survived(server: Server) -> None:
    with open_page(server) as page:
        assert receive(page, "hello")["task"] == "run"
        for text in MALFORMED:
            page.send(text)
            assert 10 < len(receive(page, "error")["message"]) < 400
        page.send(b"\x00")
        assert receive(page, "error")["message"] == "message must be text, got bytes"
        tell(page, "reset")
        receive(page, "reset")
        page.send("x" * 2**20)  # ends this connection, but not the server
        with pytest.raises(ConnectionClosed):
            receive(page, "error")
    with open_page(server) as page:
        receive(page, "hello")


def test_a_page_sees_that_time_has_stopped_after_an_error() -> None:
    session = run()
    session.advance()  # compiles the kernels
    session.policy = object()  # which cannot act
    with serve(new_session=lambda: session) as server, open_page(server) as page:
        receive(page, "error")
        number, *_, flags = HEAD.unpack_from(page.recv(timeout=60))[:4]
        assert number and not flags & 1


def test_time_stops_and_goes_on_in_single_steps(server: Server) -> None:
    with open_page(server) as page:
        assert receive(page, "hello")["dt"] == pytest.approx(1e-3)
        while receive(page, "frame") < 5:
            pass
        tell(page, "play", playing=False)
        tell(page, "reset")
        receive(page, "reset")
        steps = [receive(page, "frame")]
        for _ in range(2):
            tell(page, "step")
            steps.append(receive(page, "frame"))
        assert steps == [0, 1, 2]
        with pytest.raises(TimeoutError):
            page.recv(timeout=0.2)


def test_a_page_that_lags_behind_is_waited_for(server: Server) -> None:
    with open_page(server) as page:
        receive(page, "hello")
        frames = 0
        with contextlib.suppress(TimeoutError):
            while True:
                frames += isinstance(page.recv(timeout=0.5), bytes)
        assert 1 <= frames <= 4
        page.send("{")
        assert receive(page, "error")


def test_pages_that_come_and_go_leave_nothing(server: Server) -> None:
    def sessions() -> set[int]:
        gc.collect()
        return {id(each) for each in gc.get_objects() if type(each) is Session}

    before = sessions()  # other tests may have left some
    for _ in range(5):
        with open_page(server) as page:
            receive(page, "frame")
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        threads = [thread for thread in threading.enumerate() if thread.name.startswith("play")]
        if not (server.connections or threads or sessions() - before):
            return
        time.sleep(0.1)
    raise AssertionError((server.connections, threads, sessions() - before))


def test_only_a_few_pages_at_once(server: Server) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(LARGEST_NUMBER):
            receive(stack.enter_context(open_page(server)), "hello")
        with open_page(server) as page:
            assert "at most 4 pages" in receive(page, "error")["message"]
            with pytest.raises(ConnectionClosed):
                page.recv(timeout=10)


def test_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fractions of a step are kept; what cannot be caught up is dropped."""
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    pace = Pace(0.01)
    steps = []
    for _ in range(60):
        now[0] += 1 / 60
        steps.append(pace.due(1.0))
        pace.count(steps[-1])
    assert sum(steps) in (99, 100) and set(steps) == {1, 2}
    now[0] += 3600
    assert pace.due(1.0) <= 17 and pace.due(4.0) == 0


def test_command_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    opened: list[str] = []
    monkeypatch.setattr(Server, "run", lambda self: self._socket.close())
    monkeypatch.setattr(program.webbrowser, "open", opened.append)
    arguments = "--policy shapematch --particles 200 --target T --port 0".split()
    assert program.main(arguments) == 0
    (address,) = opened
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/\?token=[\w-]{22}", address)
    assert address in capsys.readouterr().out
    played = Session(**program.options(tyro.cli(program.Command, args=arguments)))
    assert (played.env.spec.name, played.policy_name) == ("shapematch", "shapematch")
    assert list(played.policies) == ["shapematch"] and played.env.action_resolution == 32
    assert not played.env.spec.target[40, 20]
    with socket.create_server(("127.0.0.1", 0)) as other:
        for text, message in (
            ("fly", "task must be one of"),
            ("run --target star", "'target'"),
            ("run --policy nowhere", "there is no policy"),
            ("run --particles 0", "particles must"),
            ("run --body nowhere.png", "no such file"),
            ("run --particles 200 --port 99999", "port must"),
            ("run --particles 200 --root-path example.org/user", "root_path must"),
            (f"run --particles 200 --port {other.getsockname()[1]}", "in use"),
        ):
            assert program.main(text.split()) > 0
            error = capsys.readouterr().err
            assert error.startswith("error: ") and message in error and error.count("\n") == 1


def test_policies_of_other_algorithms_are_played_where_these_are_registered(tmp_path: Path) -> None:
    path = tmp_path / "policy.safetensors"
    config = configure({"algo": "gradient", "task": "run"})
    OpenLoop(torch.zeros(3, 2, 4, 4), describe_run(config, "gradient", 1, 0)).save(path)
    read = program.options(program.Command(policy=str(path)))["policies"][str(path)]
    assert isinstance(read(), OpenLoop)


def test_without_the_extra(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delitem(sys.modules, "cfp.play.server")
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    assert program.main(["run"]) == 2
    assert "pip install torchmpm[play]" in capsys.readouterr().err

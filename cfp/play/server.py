"""The server of the page: static files, and one WebSocket for each page that is open."""

from __future__ import annotations

import asyncio
import logging
import re
import secrets
import socket
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import torch
import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers, QueryParams
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from cfp.play import protocol
from cfp.play.session import Answers, Session
from dittogym.render.replay import SCENE
from torchmpm import checks

#: The files of the page by name.
FILES = {path.name: path for path in (*(Path(__file__).parent / "page").iterdir(), SCENE)}
HOSTS = ["127.0.0.1", "localhost"]
#: Frames a second, and frames that may be on their way to a page.
FRAMES_PER_SECOND, IN_FLIGHT = 60, 3
#: Seconds after which no further control step is begun for a frame.
BUDGET = 1 / 30
#: Pages that may be open at once; each has a simulation of its own.
LARGEST_NUMBER = 4
#: Seconds over which the achieved speed is averaged.
AVERAGED = 1.0
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
log = logging.getLogger(__name__)


class Server:
    """Serves the page to clients that send the token.

    Args:
        new_session: Makes the simulation of a page that was opened.
        token: Must be in the address of the page.
        port: Of 127.0.0.1; 0: one that is free.
        root_path: The address at which a proxy serves the page, ``"https://example.org/user/me/proxy/8000"``, or its
            path alone if the proxy passes on the host that the browser asked for. The proxy may take the path away.

    Raises:
        OSError: The port is taken.
        ValueError: There is no such port, or ``root_path`` is neither an address nor a path.
    """

    def __init__(self, new_session: Callable[[], Session], token: str, port: int, root_path: str = "") -> None:
        self.new_session, self.token = new_session, token
        self.connections: set[Connection] = set()
        if (found := re.fullmatch(r"(https?://[^/?#]+)?((?:/[^/?#]+)*)/?", root_path)) is None:
            raise ValueError(f"root_path must be a path or an address that begins with http, got {root_path!r}")
        #: The address of the proxy, from whose pages alone connections come then, as browsers write it; and the prefix.
        self.proxy, self.prefix = found[1] and found[1].lower(), found[2]
        routes: list[BaseRoute] = [
            Route("/", self.page),
            Route("/page/{name}", self.file),
            WebSocketRoute("/ws", self.play),
        ]
        if self.prefix:
            routes.append(Mount(self.prefix, routes=routes.copy()))
        # Not under other names of this machine.
        hosts = HOSTS if self.proxy is None else [*HOSTS, str(urlsplit(self.proxy).hostname)]
        app = Starlette(routes=routes, middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=hosts)])
        self._socket = socket.create_server((HOSTS[0], checks.whole("port", port, 0, 65535)))
        self.port: int = self._socket.getsockname()[1]
        options: dict[str, Any] = {"log_level": "warning", "ws_max_size": protocol.LARGEST_MESSAGE, "lifespan": "off"}
        self._server = uvicorn.Server(uvicorn.Config(app, timeout_graceful_shutdown=1, **options))

    @property
    def address(self) -> str:
        """Address of the page, with the token."""
        return f"{self.proxy or f'http://{HOSTS[0]}:{self.port}'}{self.prefix}/?token={self.token}"

    def run(self) -> None:
        """Serve until Ctrl-C, or until :meth:`stop` is called in another thread."""
        with self._socket:
            self._server.run(sockets=[self._socket])

    def stop(self) -> None:
        """Let :meth:`run` return."""
        self._server.should_exit = True

    async def page(self, request: Request) -> Response:
        """Serve the page."""
        if not has_token(request.query_params, self.token):
            return PlainTextResponse("Open the address that the program printed; it ends in a token.", 403)
        return FileResponse(FILES["index.html"], headers=HEADERS)

    async def file(self, request: Request) -> Response:
        """Serve what the page loads."""
        if (path := FILES.get(request.path_params["name"])) is None:
            return PlainTextResponse("There is no such file.", 404)
        return FileResponse(path, headers=HEADERS)

    async def play(self, websocket: WebSocket) -> None:
        """Play with a page until it is closed."""
        if not has_token(websocket.query_params, self.token) or not self.own_origin(websocket.headers):
            await websocket.close(1008)  # it was not accepted yet: the status is 403
            return
        await websocket.accept()
        if len(self.connections) >= LARGEST_NUMBER:
            message = f"at most {LARGEST_NUMBER} pages can play at once: close another one, then load this one again"
            await websocket.send_json({"type": "error", "message": message})
            await websocket.close(1013)
            return
        connection = Connection(websocket)
        self.connections.add(connection)
        try:
            await connection.run(self.new_session)
        finally:
            self.connections.discard(connection)

    def own_origin(self, headers: Headers) -> bool:
        """Whether a WebSocket was opened by a page of this server: browsers let those of any server open one."""
        origin, own = headers.get("origin"), self.proxy or f"http://{headers.get('host')}"
        if origin != own:
            log.warning("refused a page of %s; if that is your proxy: --root-path %s%s", origin, origin, self.prefix)
        return origin == own


def has_token(query: QueryParams, token: str) -> bool:
    """Whether a request has the token."""
    return secrets.compare_digest(query.get("token", "").encode(), token.encode())


class Connection:
    """A page that is open: reads its messages, lets time pass in its simulation, and sends frames."""

    def __init__(self, websocket: WebSocket) -> None:
        self.websocket = websocket
        self.inbox: list[protocol.Message] = []
        self.news = asyncio.Event()
        self.sent = self.seen = 0

    async def run(self, new_session: Callable[[], Session]) -> None:
        """Play until the page is closed."""
        # Torch's threads belong to the thread that calls it. One robot gains nothing from several, and the browser
        # needs the other cores.
        executor = ThreadPoolExecutor(1, "play", torch.set_num_threads, (1,))
        tasks = [asyncio.create_task(self.simulate(new_session, executor)), asyncio.create_task(self.read())]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        except WebSocketDisconnect:
            pass
        except Exception:
            log.exception("the simulation of a page has failed")
            await self.websocket.close(1011)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            executor.shutdown(wait=False, cancel_futures=True)

    async def read(self) -> None:
        """Read messages; wrong ones are answered and have no effect."""
        while True:
            content = await self.websocket.receive()
            if content["type"] == "websocket.disconnect":
                raise WebSocketDisconnect(content.get("code", 1005))
            try:
                if content.get("text") is None:
                    raise ValueError("message must be text, got bytes")
                message = protocol.parse(content["text"])
            except ValueError as error:
                await self.websocket.send_json({"type": "error", "message": str(error)})
                continue
            if isinstance(message, protocol.Seen):
                self.seen = min(message.frame, self.sent)
            else:
                self.inbox.append(message)
            self.news.set()

    async def simulate(self, new_session: Callable[[], Session], executor: ThreadPoolExecutor) -> None:
        """Let time pass, and send a frame whenever something has changed."""
        loop = asyncio.get_running_loop()
        session = await loop.run_in_executor(executor, new_session)
        await self.websocket.send_json({"type": "hello", **session.describe()})
        terms, pace = list(session.terms), Pace(session.control_step)
        while True:
            start = time.perf_counter()
            messages, self.inbox = self.inbox, []
            due = pace.due(session.speed if session.playing else 0.0)
            answers, taken = await loop.run_in_executor(executor, work, session, messages, due)
            pace.count(taken)
            for answer in answers:
                await self.websocket.send_json(answer)
            if terms != list(session.terms):
                terms = list(session.terms)
                await self.websocket.send_json({"type": "terms", "names": terms})
            if taken or messages or answers or not self.sent:
                await self.websocket.send_bytes(session.frame(pace.rate))
                self.sent += 1
            await asyncio.sleep(max(0.0, start + 1 / FRAMES_PER_SECOND - time.perf_counter()))
            # For a page that lags behind, and while time is stopped for a message.
            while self.sent - self.seen >= IN_FLIGHT or (not session.playing and not self.inbox):
                self.news.clear()
                await self.news.wait()


class Pace:
    """Turns passing time into control steps that are due, and measures how fast they are taken.

    Attributes:
        rate: Simulated seconds per second.
    """

    def __init__(self, control_step: float) -> None:
        self.control_step, self.rate, self._owed, self._taken = control_step, 0.0, 0.0, 0
        self._last = self._since = time.perf_counter()

    def due(self, speed: float) -> int:
        """Control steps that are due at so many simulated seconds per second; what cannot be caught up is dropped."""
        now = time.perf_counter()
        self._owed = min(self._owed + speed * (now - self._last) / self.control_step, 16.0)
        self._last = now
        steps = int(self._owed)
        self._owed -= steps
        return steps

    def count(self, taken: int) -> None:
        """Count control steps."""
        self._taken += taken
        if (passed := time.perf_counter() - self._since) > AVERAGED:
            self.rate = self._taken * self.control_step / passed
            self._taken, self._since = 0, time.perf_counter()


def work(session: Session, messages: list[protocol.Message], due: int) -> tuple[Answers, int]:
    """Apply messages and take the control steps that are due, as far as time allows; returns answers and steps."""
    answers: Answers = []
    before, end = session.num_steps, time.perf_counter() + BUDGET
    for message in messages:
        answers += attempt(partial(session.apply, message))
    while session.playing and session.num_steps - before < due and time.perf_counter() < end:
        answers += attempt(session.advance)
    return answers, session.num_steps - before


def attempt(action: Callable[[], Answers | None]) -> Answers:
    """Answers of an action, or the error for the page: it asked for something impossible, or a user's task failed."""
    try:
        return action() or []
    except ValueError as error:
        return [{"type": "error", "message": str(error)}]
    except Exception as error:
        log.exception("the simulation has raised an error")
        return [{"type": "error", "message": f"{type(error).__name__}: {error}"}]

"""``python -m cfp.play TASK``: a page in the browser to play with a robot."""

from __future__ import annotations

import contextlib
import secrets
import sys
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import tyro

from cfp.errors import ConfigError
from cfp.experiment.cli import read_command, run_command
from cfp.policy import read_policy, shipped
from cfp.registry import load
from dittogym.tasks import check_task

#: Options of its training that a policy plays with, too, unless the command line says otherwise.
FROM_POLICY = ("dt", "substeps", "dtype", "target", "variant")
EXAMPLES = ("run", "--policy runs/kick", "shapematch --target M --particles 1000", "run --body robot.png")


@dataclass(frozen=True)
class Command:
    """Play with a robot on a page in the browser."""

    task: tyro.conf.Positional[str | None] = None
    """A task, or MODULE:NAME for a custom one; without it the task of the policy, else run."""
    policy: str | None = None
    """Policy that acts at once: a pretrained one by name, a policy file, or a run folder; the page offers others."""
    particles: Literal["full", "lite"] | int = "lite"
    """Particles: lite (about 2,000), full (the paper's), or a number."""
    resolution: Literal["coarse", "fine"] | int = "fine"
    """Rows and columns of the action image; policies bring their own."""
    target: str | None = None
    """Target shape of SHAPE MATCH: a name or the path of an image."""
    body: str | None = None
    """Robot: the path of an image in which it is drawn, dark on white, bright on black, or on a transparent ground."""
    seed: int = 0
    """Seed of the particles."""
    port: int = 0
    """Port of the page; 0: one that is free."""
    root_path: str = ""
    """Where a proxy serves the page, such as https://example.org/user/me/proxy/8000."""
    browser: bool = True
    """Open the page in a browser."""


def options(command: Command) -> dict[str, Any]:
    """Arguments of :class:`cfp.play.session.Session`."""
    known = {name: read_policy(name)[1] for name in shipped()}
    chosen: dict[str, Any] = {}
    if command.policy is not None:
        known[command.policy] = read_policy(command.policy)[1]
        environment = known[command.policy]["environment"]
        chosen = {name: environment[name] for name in FROM_POLICY if environment.get(name) is not None}
    task = command.task or (known[command.policy]["task"] if command.policy else "run")
    check_task(task)
    names = [name for name, about in known.items() if about["task"] == task or name == command.policy]
    given = {name: getattr(command, name) for name in ("particles", "resolution", "seed", "policy", "target", "body")}
    chosen |= {name: value for name, value in given.items() if value is not None}
    return chosen | {"task": task, "policies": {name: partial(load, name) for name in names}}


def play(command: Command) -> None:
    """Serve the page until Ctrl-C."""
    try:
        from cfp.play.server import Server
        from cfp.play.session import Session
    except ModuleNotFoundError as error:
        raise ConfigError(f"the page needs a web server: pip install torchmpm[play] ({error})") from error
    try:
        new_session = partial(Session, **options(command))
        new_session()  # what is wrong with the options shows before a page is opened
        server = Server(new_session, secrets.token_urlsafe(16), command.port, command.root_path)
    except (TypeError, ValueError) as error:
        raise ConfigError(str(error)) from error
    print(f"Play at {server.address}\nCtrl-C stops the program.", flush=True)
    if command.browser:
        webbrowser.open(server.address)
    with contextlib.suppress(KeyboardInterrupt):
        server.run()


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return run_command(lambda: play(read_command(Command, "cfp.play", EXAMPLES, arguments)))


if __name__ == "__main__":
    sys.exit(main())

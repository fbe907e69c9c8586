"""``python -m dittogym.play TASK``: a page in the browser to play with a robot."""

from __future__ import annotations

import pkgutil
import secrets
import sys
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import tyro

from dittogym.tasks import check_task

#: Options of its training that a policy plays with, too, unless the command line says otherwise.
FROM_POLICY = ("dt", "substeps", "dtype", "parity", "target", "variant")

#: Options that the help shows.
EXAMPLES = ("run", "--policy runs/kick", "shapematch --target M --particles 1000", "run --body robot.png")


@dataclass(frozen=True)
class Command:
    """Play with a robot on a page in the browser."""

    task: tyro.conf.Positional[str | None] = None
    """A task, or MODULE:NAME for a custom one; without it the task of the policy, else run."""
    policy: str | None = None
    """A pretrained policy by name, a policy file, or a run folder; it acts at once. Pretrained policies for the task
    can also be chosen on the page."""
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
    browser: bool = True
    """Open the page in a browser."""


def load_policy(path: str) -> Any:
    """A policy of any kind. The packages that load them depend on this one, so they are looked up by name."""
    kind = pkgutil.resolve_name("cfp.policy:read_policy")(path)[1]["kind"]
    return pkgutil.resolve_name("cfp:load" if kind == "cfp" else "baselines:load")(path)


def options(command: Command) -> dict[str, Any]:
    """Arguments of :class:`dittogym.play.session.Session`."""
    weights = pkgutil.resolve_name("cfp.policy")
    known = {name: weights.read_policy(name)[1] for name in weights.shipped()}
    chosen: dict[str, Any] = {}
    if command.policy is not None:
        known[command.policy] = weights.read_policy(command.policy)[1]
        environment = known[command.policy]["environment"]
        chosen = {name: environment[name] for name in FROM_POLICY if environment.get(name) is not None}
    task = command.task or (known[command.policy]["task"] if command.policy else "run")
    check_task(task)
    names = [name for name, about in known.items() if about["task"] == task or name == command.policy]
    given = {name: getattr(command, name) for name in ("particles", "resolution", "seed", "policy", "target", "body")}
    chosen |= {name: value for name, value in given.items() if value is not None}
    return chosen | {"task": task, "policies": {name: partial(load_policy, name) for name in names}}


def play(command: Command) -> None:
    """Serve the page until Ctrl-C."""
    try:
        from dittogym.play.server import Server
        from dittogym.play.session import Session
    except ModuleNotFoundError as error:
        raise OSError(f"the page needs a web server: pip install torchmpm[play] ({error})") from error
    try:
        new_session = partial(Session, **options(command))
        new_session()  # what is wrong with the options shows before a page is opened
    except (TypeError, pkgutil.resolve_name("cfp:CFPError")) as error:
        raise ValueError(str(error)) from error
    try:
        server = Server(new_session, secrets.token_urlsafe(16), command.port)
    except OSError as error:
        raise OSError(f"port: {command.port} cannot be used ({error.strerror})") from error
    print(f"Play at {server.address}\nCtrl-C stops the program.", flush=True)
    if command.browser:
        webbrowser.open(server.address)
    server.run()


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    console = arguments is None and sys.argv[0].startswith("torchmpm ")
    program = sys.argv[0] if console else "python -m dittogym.play"
    examples = "".join(f"\n  {program} {words}" for words in EXAMPLES)
    description = f"{Command.__doc__}\n\nExamples:{examples}"
    command = tyro.cli(Command, prog=program, description=description, args=arguments)
    try:
        play(command)
    except KeyboardInterrupt:
        return 0
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

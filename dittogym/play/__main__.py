"""``python -m dittogym.play TASK``: a page in the browser to play with a robot."""

from __future__ import annotations

import pkgutil
import secrets
import sys
import webbrowser
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import tyro

from dittogym.play.session import Policy, Session
from dittogym.tasks import allowed_instead

MISSING = "playing needs a web server, which is not installed: pip install torchmpm[play]"
#: Options of its training that a policy plays with, too, unless the command line says otherwise.
FROM_POLICY = ("dt", "substeps", "dtype", "parity", "target", "variant")


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
    body: Path | None = None
    """Robot: the path of an image. Bright pixels belong to it."""
    seed: int = 0
    """Seed of the particles."""
    port: int = 0
    """Port of the page; 0: one that is free."""
    browser: bool = True
    """Open the page in a browser."""


def load_policy(path: str) -> Policy:
    """A policy of any kind. The packages that load them depend on this one, so they are looked up by name."""
    kind = pkgutil.resolve_name("cfp.weights:read_policy")(path)[1]["kind"]
    policy: Policy = pkgutil.resolve_name("cfp:load" if kind == "cfp" else "baselines:load")(path)
    return policy


def make_session(command: Command) -> Callable[[], Session]:
    """What makes the simulation of a page.

    Raises:
        ValueError: An option is wrong.
        TypeError: The task has no such option.
    """
    weights = pkgutil.resolve_name("cfp.weights")
    options: dict[str, Any] = {}
    described = {name: weights.read_policy(name)[1] for name in weights.shipped()}
    if command.policy is not None:
        described[command.policy] = weights.read_policy(command.policy)[1]
        told = described[command.policy]["environment"]
        options = {name: told[name] for name in FROM_POLICY if told.get(name) is not None}
    task = command.task or (described[command.policy]["task"] if command.policy else "run")
    if (allowed := allowed_instead(task)) is not None:
        raise ValueError(f"task must be one of {allowed}, got {task!r}")
    given = {"target": command.target, "body": command.body}
    options |= {name: value for name, value in given.items() if value is not None}
    options |= {"particles": command.particles, "resolution": command.resolution}
    names = [name for name, about in described.items() if about["task"] == task or name == command.policy]
    policies = {name: partial(load_policy, name) for name in names}
    return partial(Session, task, policies, command.policy, command.seed, **options)


def serve(new_session: Callable[[], Session], port: int, browser: bool) -> None:
    """Serve the page until Ctrl-C."""
    from dittogym.play.server import Server  # what it needs is an extra

    server = Server(new_session, secrets.token_urlsafe(16), port)
    print(f"Play at {server.address}\nCtrl-C stops the program.", flush=True)
    if browser:
        webbrowser.open(server.address)
    server.run()


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    command = tyro.cli(Command, prog="python -m dittogym.play", args=arguments)
    try:
        new_session = make_session(command)
        new_session()  # what is wrong with the options shows before a page is opened
        serve(new_session, command.port, command.browser)
    except ModuleNotFoundError as error:
        print(f"error: {MISSING} ({error})", file=sys.stderr)
        return 2
    except (ValueError, TypeError, OSError, pkgutil.resolve_name("cfp.errors:CFPError")) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

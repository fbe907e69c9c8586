"""What a page may ask of a simulation, without a server or a browser."""

import base64
import io
import json
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import cfp
from cfp import ActorPolicy, ActorSpec
from cfp.play import protocol
from cfp.play.hand import wave
from cfp.play.protocol import HEAD, Draw, Hand, Matter, Paint, Reset, Save, Step, Wave, parse
from cfp.play.session import FLAGS, Session
from dittogym import TASKS, TorchEnv, make_spec

SMALL = {"particles": 200, "substeps": 10}


@dataclass
class Constant:
    """A policy with one action, which counts its steps in its memory."""

    resolution: int = 4
    deterministic_by_default: bool = True
    description: dict[str, Any] = field(default_factory=dict)

    def predict(self, observation, state, episode_start, deterministic):
        assert observation.shape == (1, 3, 64, 64) and deterministic == self.deterministic_by_default
        action = np.zeros((1, 2, self.resolution, self.resolution), np.float32)
        action[0, 0, 0] = 0.5  # the top row
        return action, (np.array([1 if state is None else state[0][0] + 1]),)


def saved_file(played: Session, what: str) -> io.BytesIO:
    """A file that is sent to the page."""
    (answer,) = played.apply(Save(what))
    return io.BytesIO(base64.b64decode(answer["content"]))


def session(task: str = "run", **arguments: Any) -> Session:
    return Session(task, **(SMALL | arguments))


def shown(played: Session) -> SimpleNamespace:
    """The next frame as the page reads it."""
    frame = played.frame(1.0)
    number, step, echo, flags, rows, width, count, resolution, gate, *numbers = HEAD.unpack_from(frame)
    result = SimpleNamespace(number=number, step=step, echo=echo, numbers=numbers)
    result.flags = {name for bit, name in enumerate(FLAGS) if flags >> bit & 1}
    shapes = {
        "rows": ("<f4", (rows, width)),
        "positions": ("<f4", (count, 2)),
        "codes": ("u1", (count,)),
        "observation": ("u1", (3, 64, 64)),
        "action": ("i1", (2, resolution, resolution)),
        "gate": ("u1", (2, gate, gate)),
    }
    at = HEAD.size
    for name, (kind, shape) in shapes.items():
        array = np.frombuffer(frame, kind, int(np.prod(shape)), at).reshape(shape)
        setattr(result, name, array)
        at += array.nbytes
    assert at == len(frame)
    return result


@pytest.mark.parametrize("task", sorted(TASKS))
def test_every_task_can_be_played(task: str) -> None:
    played = session(task)
    about = json.loads(json.dumps(played.describe(), allow_nan=False))
    assert about["task"] == task and sum(body["count"] for body in about["bodies"]) == played.env.num_particles
    assert ("target" in about["draws"]) == (task == "shapematch") == bool(about["target"])
    for _ in range(2):
        played.advance()
    frame, state = shown(played), played.env.env_state
    assert frame.step == 2 and "playing" in frame.flags and len(frame.rows) == 2
    assert frame.rows[-1, 0] == pytest.approx(frame.numbers[4]) == played.history.total
    assert np.array_equal(frame.positions, state.particles.x[0])
    assert np.array_equal(frame.observation, played.observation[0])
    assert len(shown(played).rows) == 0


def test_a_pull_takes_hold_at_the_press_and_keeps_it() -> None:
    """Although the pointer is far away before time goes on, and the robot hangs on its uppermost matter."""
    played = session(particles="lite", substeps=100)
    num_robot = played.env.model.num_robot_particles
    start = played.env.state.x[0, :num_robot]
    top = start[start[:, 1].argmax()]
    played.apply(Hand("pull", float(top[0]), float(top[1]) + 0.03))
    for _ in range(100):
        played.apply(Hand("pull", float(top[0]), float(top[1]) + 0.23))
        played.advance()
    x = played.env.state.x[0, :num_robot]
    uppermost = x[(start - top).norm(dim=1) < 0.03].mean(0)
    assert abs(float(uppermost[1] - top[1]) - 0.2) < 0.05 and abs(float(uppermost[0] - top[0])) < 0.03
    assert float((x - start).mean(0)[1]) > 0.15 and np.ptp(x.numpy(), axis=0).max() < 0.22  # all of it, in one piece
    for tool, holds in (("pull", True), (None, False), ("pull", False)):  # still holds it, lets go, and finds nothing
        played.apply(Hand(tool, 9.0, 9.0, id=7))
        played.advance()
        assert (played.grip is not None) == holds
    assert shown(played).echo == 7


def test_muscles_under_the_pointer() -> None:
    """The action has its largest value in the cell that holds the pointer, and acts there."""
    played = session(resolution=16)
    corner, cell = played._corner(), 0.5 / 16
    for tool, sign in (("contract", 1), ("expand", -1)):
        played.apply(Hand(tool, corner[0] + 5.5 * cell, corner[1] + 0.5 - 7.5 * cell))
        played.advance()
        action = sign * played.history.actions[-1]
        corner = played._corner()
        assert np.unravel_index(action[0].argmax(), (16, 16)) == (7, 5) and action.max() == pytest.approx(1, abs=0.1)
        at = (played.shot.x[:, 0] - played.hand.x) ** 2 + (played.shot.x[:, 1] - played.hand.y) ** 2
        assert np.abs(played.shot.values["muscle"][at < 0.01**2] - 127.5).min() > 100


def test_paint_waves_and_policy_add_up() -> None:
    played = session(policies={"constant": lambda: Constant(deterministic_by_default=False)}, policy="constant")
    played.apply(Paint("vertical", -1.0, [[3, 0], [3, 1]]))
    played.advance()
    expected = np.zeros((2, 4, 4))
    expected[0, 0], expected[1, 3, :2] = 0.5, -1.0
    assert np.array_equal(played.history.actions[-1], expected)
    played.apply(protocol.Clear())
    played.apply(Wave("up"))
    played.advance()
    expected[1] = 0.0
    assert np.allclose(played.history.actions[-1], np.clip(wave("up", 1, 4) + expected, -1, 1))
    assert played.history.memory[0][0] == 2
    with pytest.raises(ValueError, match="cells must"):
        played.apply(Paint("both", 1.0, [[4, 0]]))


def test_a_policy_brings_its_resolution() -> None:
    played = session(policies={"constant": Constant})
    before = played.env.state.x.clone()
    played.apply(protocol.Policy("constant"))
    assert torch.equal(before, played.env.state.x) and shown(played).action.shape == (2, 4, 4)
    played.apply(protocol.Policy(None))
    assert played.env.action_resolution == make_spec("run").coarse
    with pytest.raises(ValueError, match="name must"):
        played.apply(protocol.Policy("/etc/passwd"))


def test_a_policy_that_cannot_act_changes_nothing() -> None:
    broken = Constant()
    broken.attached = lambda env: int("no")
    played = session(policies={"broken": lambda: broken})
    env = played.env
    with pytest.raises(ValueError, match="invalid literal"):
        played.apply(protocol.Policy("broken"))
    assert played.env is env and played.policy is None and played.painted.shape == env.action_shape


def test_waves_travel() -> None:
    for direction, axis, sign in (("right", 2, 1), ("left", 2, -1), ("down", 1, 1), ("up", 1, -1)):
        now, later = (wave(direction, step, 64) for step in (0, 5))  # phase 1.5
        shift = round(sign * 1.5 / (2 * np.pi * 2) * 64)
        assert np.abs(np.roll(now, shift, axis) - later).max() < 0.1


def test_policies_with_other_orientations_and_gates() -> None:
    """An action of the reference's orientation is turned; the gate of a policy with several stages is shown."""
    turned = Constant(description={"environment": {"action_layout": "grid"}})
    played = session(policies={"turned": lambda: turned}, policy="turned")
    played.advance()
    assert (played.history.actions[-1][0, :, 0] == 0.5).all() and played.history.actions[-1].sum() == 2.0
    fine = ActorPolicy(ActorSpec((8, 16), gate_bias=(0.0,)), deterministic_by_default=True)
    played = session(policies={"fine": lambda: fine}, policy="fine")
    played.advance()
    assert shown(played).gate.shape == (2, 16, 16) and shown(played).gate.any()


def test_matter_changes_while_it_moves_and_stays_after_a_reset() -> None:
    played = session()
    played.apply(Matter(stiffness=2.0, yield_stress=0.5, gravity=3.0))
    for _ in range(2):
        physics = played.env.env_state.physics
        assert {name: value.flatten().tolist() for name, value in physics.items()} == {
            "mu": [1300.0], "lam": [100.0], "yield_stress": [45.0], "gravity": [0.0, -3.0],
        }  # fmt: skip
        played.apply(Reset())
    played.apply(Matter(stiffness=1.0, yield_stress=1.0, gravity=9.0))
    assert played.env.env_state.physics == {} and played.history.touched
    played.apply(Reset())
    assert not played.history.touched  # nothing but the actions decides about the episode
    played.apply(Matter(stiffness=2.0, yield_stress=1.0, gravity=9.0))
    played.apply(Reset())
    assert played.history.touched == ["other matter or gravity"]
    with pytest.raises(ValueError, match="dt must"):
        played.apply(Matter(stiffness=1e4, yield_stress=1.0, gravity=9.0))
    played.advance()


def test_moments() -> None:
    played = session()
    with pytest.raises(ValueError, match="moment"):
        played.apply(protocol.Back())
    assert not played.describe()["saved"]
    played.advance()
    snapshot = torch.load(saved_file(played, "moment"), weights_only=True)
    then = played.env.state.x.clone()
    played.advance()
    played.apply(protocol.Back())
    frame = shown(played)
    assert torch.equal(played.env.state.x, then) and (frame.step, len(frame.rows)) == (1, 0)
    assert played.describe()["saved"] and not played.history.touched
    played.apply(Matter(stiffness=2, yield_stress=1, gravity=9))
    assert played.apply(protocol.Back()) == [{"type": "reset"}]
    assert played.history.touched == ["other matter or gravity"]
    env = TorchEnv("run", **SMALL)
    env.load(snapshot)
    assert torch.equal(env.state.x, then)


def test_going_back_restores_the_outcome_and_the_memory_of_the_same_policy() -> None:
    played = session(policies={"constant": Constant}, policy="constant")
    played.advance()
    played.history.success = played.history.invalid = True
    played.apply(Save("moment"))
    played.apply(Reset())
    played.advance()
    played.advance()
    assert not played.history.success and not played.history.invalid and played.history.memory[0][0] == 2
    played.apply(protocol.Back())
    played.apply(protocol.Play(True))
    assert played.history.success and played.history.invalid and not played.playing
    assert played.history.memory[0][0] == 1
    played.apply(protocol.Policy("constant"))
    played.apply(protocol.Back())
    assert played.history.memory is None  # of another policy


def test_a_drawing_with_which_the_policy_cannot_act_changes_nothing() -> None:
    policy, loaded = Constant(resolution=4), []

    def load() -> Constant:
        loaded.append(policy)
        if len(loaded) == 2:
            raise OSError("the file is gone")
        return policy

    played = session(policies={"constant": load}, policy="constant")
    played.advance()
    before = vars(played).copy()
    with pytest.raises(OSError, match="gone"):
        played.apply(protocol.Draw("body", np.full((64, 64), 255, np.uint8).tobytes()))
    assert all(vars(played)[name] is value for name, value in before.items())
    played.advance()
    assert len(played.history.actions) == 2 and played.history.recording.rewards


def test_files_after_going_back_are_of_what_led_there() -> None:
    """In the same episode, twice, and from a later one of another seed."""
    played = session(seed=3)
    for direction in ("right", "up"):
        played.apply(Wave(direction))
        for _ in range(3):
            played.advance()
    played.apply(Save("moment"))
    kept, total = played.history.actions.copy(), played.history.total
    for reset in (None, None, Reset(seed=8)):
        if reset is not None:
            played.apply(reset)
        for _ in range(4):
            played.advance()
        played.apply(protocol.Back())
        assert played.history.total == pytest.approx(total) == sum(played.history.recording.rewards)
        assert [shot.step for shot in played.history.recording.shots] == list(range(7))
        played.advance()
        assert played.history.total == pytest.approx(sum(played.history.recording.rewards))
    assert b'"rewards":[' in saved_file(played, "replay").read()
    saved = np.load(saved_file(played, "actions"))
    assert np.array_equal(saved["actions"][:6], kept) and len(saved["actions"]) == 7 and saved["seed"] == 3
    assert not len(saved["touched"]), "the actions alone repeat the episode"
    env = TorchEnv("run", **SMALL)
    env.reset(seed=3)
    for action in saved["actions"]:
        env.step(torch.from_numpy(action)[None])
    assert torch.equal(env.state.x, played.env.state.x)


def drawing(mask: np.ndarray, what: str, scale: float = 1.0) -> Draw:
    return Draw(what, (mask.astype(np.uint8) * 255).tobytes(), scale)


def test_drawings() -> None:
    """A drawn robot stands where the task's stood; a drawn target is what the reward compares with."""
    y, x = np.mgrid[:128, :128] - 63.5
    played = session("shapematch")
    played.advance()
    names = list(played.terms)
    played.apply(Reset())
    assert list(played.terms) == names and shown(played).rows.shape == (0, 1 + len(names))
    hello, reset, *_ = played.apply(drawing(np.hypot(x, y) < 30, "target"))
    assert (hello["type"], hello["terms"]) == ("hello", names) and reset["type"] == "reset"
    assert played.env.spec.target[32, 32] and not played.env.spec.target[:10].any()
    played.apply(drawing((abs(x) < 40) & (abs(y) < 20), "body"))
    width, height = np.ptp(played.env.state.x[0].numpy(), axis=0)
    assert width / height == pytest.approx(2.0, rel=0.1) and played.env.spec.target[32, 32]
    before = played.env
    with pytest.raises(ValueError, match="body must"):
        played.apply(drawing(np.zeros((64, 64)), "body"))
    assert played.env is before
    answers = played.apply(drawing(np.hypot(abs(x) - 30, y) < 20, "target"))  # two discs
    assert answers[-1]["type"] == "notice" and "no robot can be expected" in answers[-1]["message"]


def test_a_robot_that_does_not_fit_its_place_can_be_scaled_down() -> None:
    y, x = np.mgrid[:128, :128] - 63.5
    bar = (abs(x) < 60) & (abs(y) < 8)
    for task in ("run", "obstacle"):
        played = session(task)
        with pytest.raises(ValueError, match="thicken the drawing or scale it down"):
            played.apply(drawing(bar, "body"))
        played.apply(drawing(bar, "body", scale=0.5))
        own, drawn = played.own_spec.robot, played.env.spec.robot
        assert drawn.shape.area == pytest.approx(own.shape.area / 4)
        assert drawn.shape.corner[1] == own.shape.corner[1]
        middles = [body.shape.corner[0] + body.shape.size[0] / 2 for body in (own, drawn)]
        assert middles[0] == pytest.approx(middles[1])
        assert played.history.touched == ["a drawn body"]
        played.advance()


def test_the_outline_is_that_of_the_tasks_own_robot() -> None:
    disc = session("run", body=np.ones((8, 8), bool)).describe()["outline"]
    assert len(disc) == 1 and np.allclose(np.linalg.norm(disc[0], axis=1), 50, atol=3)
    (square,) = session("obstacle").describe()["outline"]
    assert np.allclose(np.abs(square).max(axis=1), 50, atol=3)


def test_the_end_of_an_episode_is_told_and_failure_stops_time() -> None:
    played = session("shapematch")
    for _ in range(31):
        played.advance()
    assert {"truncated", "playing"} <= shown(played).flags
    total = played.history.total
    played.advance()
    assert played.history.total == total
    played.env.state.v.fill_(torch.nan)
    played.advance()
    frame = shown(played)
    assert "invalid" in frame.flags and "playing" not in frame.flags and frame.step == 33
    played.advance()
    played.apply(protocol.Play(True))
    assert shown(played).step == 33 and not played.playing
    played.apply(Reset(seed=5))
    played.apply(Step())
    assert shown(played).step == 1 and not played.playing


def test_a_shipped_policy_acts_as_it_does_elsewhere() -> None:
    policy = cfp.load("shapematch")
    played = Session("shapematch", {"shapematch": lambda: policy}, "shapematch", particles="lite")
    for _ in range(30):
        played.advance()
    assert played.history.success and 400 < played.history.total < 550  # 488 on average, with a noise of its own


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("", "truncated"),
        ("[" * 100_000, "object"),
        ('{"type": "message"}', "type"),
        ('{"type": "play"}', "playing"),
        ('{"type": "step", "count": 9}', "count"),
        ('{"type": "speed", "factor": 1e99}', "factor"),
        ('{"type": "hand", "tool": "pull", "y": 1e39}', "y"),
        ('{"type": "reset", "seed": -1}', "seed"),
        ('{"type": "matter", "stiffness": 0, "yield_stress": 1, "gravity": 9}', "stiffness"),
        ('{"type": "save", "what": "../../x"}', "what"),
        ('{"type": "draw", "what": "body", "pixels": "AAAA"}', "pixels"),
        (json.dumps({"type": "draw", "what": "body", "pixels": "A" * 88, "scale": 1.5}), "scale"),
    ],
    ids=range(12),
)
def test_malformed_messages(text: str, field: str) -> None:
    with pytest.raises(ValueError, match=field) as caught:
        parse(text)
    assert len(str(caught.value)) < 300


def test_messages() -> None:
    assert parse('{"type": "hand", "tool": "pull", "x": 0.5, "id": 7}') == Hand("pull", 0.5, 0.0, 7)
    assert parse('{"type": "paint", "muscles": "both", "value": 1, "cells": [[0, 3]]}') == Paint("both", 1, [(0, 3)])

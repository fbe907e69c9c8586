"""A task of one's own, registered without touching the library."""

import dataclasses
import hashlib
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import MappingProxyType

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3
from tiny import SMALL, actions, assert_same_bits, everything, make_vec, tiny

import dittogym
from dittogym.bodies.shapes import Disc, Figure, Lattice, Rectangle
from dittogym.contract import Moment, Outcome
from dittogym.geometry import ceiling, floor, solid
from dittogym.spec import BodySpec, TaskSpec
from dittogym.tasks import fingerprint, headline
from dittogym.window import Window
from torchmpm import Elastic, Snow, VelocityRule


@pytest.fixture(autouse=True)
def unregister() -> Iterator[None]:
    """Forget what a test registers."""
    tasks, ids = dict(dittogym.TASKS), set(gymnasium.registry)
    yield
    for name in set(gymnasium.registry) - ids:
        del gymnasium.registry[name]
    dittogym.TASKS.clear()
    dittogym.TASKS.update(tasks)


# A task in about ten lines: get high above the start.
def height(moment: Moment, spec: TaskSpec) -> Outcome:
    risen = moment.now.com[:, 1] - moment.start.com[:, 1]
    return Outcome({"height": risen}, terminated=risen > 0.3, success=risen > 0.2)


def hop(pull: float = -5.0, horizon: int = 40, coarse: int = 4) -> TaskSpec:
    robot = BodySpec(Disc((0.4, 0.16), 0.18), count=5000)
    matter = {"mu": 500.0, "yield_stress": 80.0, "max_actuation": 60.0, "gravity": (0.0, pull)}
    world = {"obstacles": (floor(), ceiling(119)), "coarse": coarse, "fine": 8}
    weights = {"height": 7.0, "action": 1e-4, "alive": 1.0}
    return TaskSpec("hop", horizon, robot, reward_fn=height, weights=weights, **matter, **world)


def test_through_gymnasium_make_in_both_resolutions() -> None:
    dittogym.register("hop", hop)
    for resolution, size in (("coarse", 4), ("fine", 8)):
        name = f"dittogym/hop-{resolution}-v0"
        assert gymnasium.spec(name).max_episode_steps == 40
        env = gymnasium.make(name, **SMALL)
        assert env.action_space.shape == (2, size, size)
        env.reset(seed=0)
        assert env.unwrapped.torch_env.spec.name == "hop"
        check_env(gymnasium.make(name, render_mode="rgb_array", **SMALL).unwrapped)
        check_env_sb3(gymnasium.make(name, **SMALL))


def test_its_own_reward_term_ending_and_success() -> None:
    dittogym.register("hop", hop)
    env = gymnasium.make("dittogym/hop-coarse-v0", **SMALL)
    _, start = env.reset(seed=0)
    still = np.zeros(env.action_space.shape, np.float32)
    _, reward, terminated, _, info = env.step(still)
    terms = {name: value for name, value in info.items() if name.startswith("reward_terms/")}
    assert set(terms) == {f"reward_terms/{name}" for name in ("height", "action", "alive", "failure")}
    risen = info["com"][1] - start["com"][1]
    assert terms["reward_terms/height"] == pytest.approx(7.0 * risen, abs=1e-6)
    assert reward == pytest.approx(sum(terms.values()), abs=1e-5)
    assert terminated is False and not info["is_success"]
    for lift, wanted in ((0.25, (False, True)), (0.1, (True, True))):
        env.unwrapped.state.x[..., 1] += lift
        _, _, terminated, _, info = env.step(still)
        assert (terminated, info["is_success"]) == wanted


def test_through_make_vec_and_torch() -> None:
    dittogym.register("hop", hop)
    env = make_vec("hop", 3, autoreset_mode="SameStep")
    single = gymnasium.make("dittogym/hop-coarse-v0", **SMALL)
    env.reset(seed=0)
    single.reset(seed=2)
    env.action_space.seed(0)
    action = env.action_space.sample()
    assert action.shape == (3, 2, 4, 4)
    observation, reward, _, _, info = env.step(action)
    seen, one, *_ = single.step(action[2])
    assert np.array_equal(observation[2], seen) and reward[2] == pytest.approx(one, abs=1e-5)
    assert info["reward_terms/height"].shape == (3,)
    env.unwrapped.state.x[1, :, 1] += 0.35
    _, _, terminated, _, info = env.step(action)
    assert terminated.tolist() == [False, True, False] and info["final_info"]["is_success"][1]
    assert tiny("hop").spec.name == "hop" and dittogym.Env("hop", **SMALL).action_space.shape == (2, 4, 4)


def test_options_of_the_function_arrive() -> None:
    dittogym.register("hop", hop)
    env = gymnasium.make("dittogym/hop-coarse-v0", pull=-1.5, coarse=6, body=Disc((0.4, 0.16), 0.1), **SMALL)
    assert env.unwrapped.torch_env.spec.gravity == (0.0, -1.5)
    assert env.action_space.shape == (2, 6, 6)
    assert env.unwrapped.torch_env.spec.robot.shape.size == (0.1, 0.1)
    assert tiny("hop", pull=-2.0).spec.gravity == (0.0, -2.0)
    message = "task 'hop' got an unexpected keyword argument 'push'; its options are body, obstacles, pull"
    with pytest.raises(TypeError, match=message):
        gymnasium.make("dittogym/hop-coarse-v0", push=1.0)
    with pytest.raises(ValueError, match=r"task must be one of catch, .*, hop, .* got 'hope'"):
        tiny("hope")


def test_a_module_that_registers_the_task_is_imported_by_name(tmp_path, monkeypatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "hopping.py").write_text(
        "import dataclasses, dittogym\n"
        "def leap(): return dataclasses.replace(dittogym.make_spec('run'), name='leap')\n"
        "dittogym.register('leap', leap)"
    )
    (tmp_path / "torn.py").write_text("1 / 0")
    (tmp_path / "lame.py").write_text("\nimport absent_one")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "hidden.py").write_text("raise AssertionError('is never imported')")
    env = tiny("hopping:leap", substeps=1)
    assert (env.spec.name, env.spec.horizon) == ("leap", dittogym.make_spec("run").horizon)
    for task, reason in (
        ("hopping:fly", "module 'hopping' does not register 'fly'"),
        ("torn:leap", "module 'torn': torn.py, line 1, ZeroDivisionError: division by zero"),
        ("lame:leap", "module 'lame': lame.py, line 2, ModuleNotFoundError: No module named 'absent_one'"),
        ("missing_one:leap", "there is no module 'missing_one' in the working directory or on the Python path"),
        ("folder.hidden:leap", "the name of a module must be a word, without dots"),
        (":leap", "the name of a module must be a word"),
        ("folder:leap", "module 'folder' is a folder, not a file"),
    ):
        with pytest.raises(ValueError, match=rf"task must be one of catch.* MODULE:NAME \({reason}.* got '{task}'"):
            dittogym.make_spec(task)


def test_the_name_is_that_of_the_specification() -> None:
    with pytest.raises(ValueError, match="task must be the name in the specification, got 'leap' for a TaskSpec 'hop'"):
        dittogym.register("leap", hop)
    assert "leap" not in dittogym.TASKS


def test_namespace_and_versions() -> None:
    for version in (0, 1):
        dittogym.register("hop", hop, version=version)
    assert {"dittogym/hop-coarse-v0", "dittogym/hop-coarse-v1"} <= set(gymnasium.registry)
    dittogym.register("hop", hop, namespace="mine", version=3)
    assert {"mine/hop-coarse-v3", "mine/hop-fine-v3"} <= set(gymnasium.registry)
    assert gymnasium.make("mine/hop-fine-v3", **SMALL).action_space.shape == (2, 8, 8)


def test_another_process_makes_the_task_from_its_specification(tmp_path: Path) -> None:
    (tmp_path / "jumping.py").write_text(
        "from dataclasses import replace\nimport dittogym\n"
        "def jump():\n    return replace(dittogym.make_spec('run'), name='jump')\n"
        "dittogym.register('jump', jump)\n"
    )
    first = "import gymnasium, jumping; print(gymnasium.spec('dittogym/jump-coarse-v0').to_json())"
    second = (
        "import sys, gymnasium; from gymnasium.envs.registration import EnvSpec; "
        "print(gymnasium.make(EnvSpec.from_json(sys.stdin.read()), particles=30, substeps=1).unwrapped.torch_env)"
    )
    text = None
    for program in (first, second):
        command = [sys.executable, "-W", "ignore", "-c", program]
        text = subprocess.run(command, cwd=tmp_path, input=text, capture_output=True, text=True, check=True).stdout
    assert text == "TorchEnv('jump', 1, 8, device='cpu')\n"


def test_a_taken_name_is_refused() -> None:
    dittogym.register("hop", hop)
    before = dict(dittogym.TASKS), set(gymnasium.registry)
    for name in ("run", "hop"):
        with pytest.raises(ValueError, match=f"task must be a new name, got '{name}', which is taken"):
            dittogym.register(name, lambda: hop())
    assert (dict(dittogym.TASKS), set(gymnasium.registry)) == before
    assert tiny("run").spec.name == "run"


@pytest.mark.parametrize(
    ("make", "options", "error", "message"),
    [
        (5, {}, TypeError, "make must be a function that returns a TaskSpec, got int"),
        (lambda pull, *, size, **rest: hop(), {}, TypeError, "make must have defaults for .* got none for pull, size$"),
        (lambda particles=3, body=None: hop(), {}, ValueError, "make must have .* other names .* got body, particles$"),
        (hop, {"version": -1}, ValueError, "version must not be negative, got -1"),
        (hop, {"version": "1"}, ValueError, "version must be a whole number, got '1'"),
    ],
)
def test_what_cannot_be_registered(make: object, options: dict, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        dittogym.register("hop", make, **options)
    assert "hop" not in dittogym.TASKS
    dittogym.register("hop", lambda *args, **options: hop())


@pytest.mark.parametrize(("result", "kind"), [(None, "NoneType"), ({"name": "hop"}, "dict"), (TaskSpec, "type")])
def test_a_function_that_returns_something_else_is_refused(result: object, kind: str) -> None:
    with pytest.raises(TypeError, match=f"make must return a TaskSpec, got {kind}"):
        dittogym.register("hop", lambda: result)
    assert "hop" not in dittogym.TASKS and "dittogym/hop-coarse-v0" not in gymnasium.registry
    with pytest.raises(TypeError, match="make must be a function that returns a TaskSpec, got TaskSpec"):
        dittogym.register("hop", hop())


def test_a_specification_is_no_name_of_a_task() -> None:
    with pytest.raises(ValueError, match=r"dittogym\.register knows the function .*, got the TaskSpec 'hop' itself"):
        dittogym.tasks.check_task(hop())


def test_a_specification_needs_no_registration() -> None:
    env = dittogym.Env(hop(), particles=50, substeps=1)
    check_env(env, skip_render_check=True)
    assert dittogym.BatchEnv(hop(), 2, particles=50, substeps=1).single_action_space.shape == (2, 4, 4)


def initial_peak(moment: Moment, spec: TaskSpec) -> dict[str, torch.Tensor]:
    return {"peak": moment.now.com[:, 1]}


def peak_reward(moment: Moment, spec: TaskSpec) -> Outcome:
    peak = torch.maximum(moment.memory["peak"], moment.now.com[:, 1])
    assert moment.now.object_com is not None
    return Outcome(
        {"peak": peak - moment.start.com[:, 1]},
        info={"peak": peak, "stone": moment.now.object_com},
        memory={"peak": peak},
    )


def test_a_memory_that_is_no_dict_is_reset_in_part() -> None:
    """It may be any mapping."""
    spec = dataclasses.replace(
        hop(),
        initial_memory=lambda moment, spec: MappingProxyType({"peak": moment.now.com[:, 1]}),
    )
    env = tiny(spec, 2)
    env.reset(seed=0)
    positions, before = env.state.x.clone(), env.env_state.memory["peak"].clone()
    positions[..., 1] += 0.1
    env.reset(options={"positions": positions, "reset_mask": [False, True]})
    assert (env.env_state.memory["peak"] - before).tolist() == pytest.approx([0.0, 0.1])


def test_memory_and_objects_of_a_task_of_ones_own() -> None:
    """The highest point so far is remembered by each element until its own reset."""
    stone = BodySpec(Rectangle((0.7, 0.16), (0.06, 0.06)), count=500, mass=4.0)
    spec = dataclasses.replace(
        hop(),
        objects=(stone,),
        initial_memory=initial_peak,
        reward_fn=peak_reward,
        weights={"peak": 7.0},
        gravity=(0.0, 0.0),
    )
    env = tiny(spec, 2, particles=(100, 30))
    env.reset(seed=0)
    start = env.state.x[:, :100, 1].mean(1)
    still = torch.zeros(2, *env.action_shape, dtype=env.dtype)
    env.state.x[:, :100, 1] += torch.tensor([[0.1], [0.2]])
    env.step(still)
    env.state.x[:, :100, 1] -= torch.tensor([[0.1], [0.2]])
    info = env.step(still)[-1]
    assert info["peak"].tolist() == pytest.approx((start + torch.tensor([0.1, 0.2])).tolist(), abs=1e-3)
    assert info["reward_terms"]["peak"].tolist() == pytest.approx([0.7, 1.4], abs=1e-2)
    assert info["stone"].tolist() == info["object_com"].tolist()
    assert info["stone"][0].tolist() == pytest.approx([0.73, 0.19], abs=0.01)
    env.reset(options={"reset_mask": [True, False]})
    info = env.step(still)[-1]
    assert info["reward_terms"]["peak"].tolist() == pytest.approx([0.0, 1.4], abs=1e-2)
    assert "is_success" not in info


def test_a_reset_of_some_elements_leaves_the_others_alone() -> None:
    """Only the positions and images of the elements that are reset are computed."""
    sizes = []

    def memory(moment: Moment, spec: TaskSpec) -> dict[str, torch.Tensor]:
        sizes.append((len(moment.particles.x), len(moment.observation)))
        return {"start": moment.now.com}

    env = tiny(dataclasses.replace(hop(), initial_memory=memory), 3)
    env.reset(seed=0)
    env.reset(options={"reset_mask": [False, True, False]})
    assert sizes == [(3, 3), (1, 1)]


def test_a_reset_that_fails_changes_nothing() -> None:
    working = True

    def memory(moment: Moment, spec: TaskSpec) -> dict[str, torch.Tensor]:
        return {"start": moment.now.com} if working else {}["missing"]

    spec = dataclasses.replace(hop(), initial_memory=memory)
    env, untouched = (tiny(spec, 2, resample=True) for _ in range(2))
    env.reset(seed=0), untouched.reset(seed=0)
    before, working = everything(env), False
    for options in ({"physics": {"mu": 100.0}}, {"positions": env.state.x + 0.01}, {"reset_mask": [True, False]}):
        with pytest.raises(KeyError):
            env.reset(seed=[7, None], options=options)
    assert_same_bits(everything(env), before)
    working = True
    env.reset(), untouched.reset()
    assert_same_bits(everything(env), everything(untouched))


def test_weights_name_every_term() -> None:
    env = tiny(dataclasses.replace(hop(), weights={"heigth": 7.0}))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"weights of task 'hop' must hold every term .* got none for \['height'\]"):
        env.step(actions(env, 1)[0])
    env = tiny(dataclasses.replace(hop(), weights={"height": 7.0, "alve": 1.0}))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"weights of task 'hop' must be of the terms .* got \['alve'\]"):
        env.step(actions(env, 1)[0])


def test_a_term_in_double_precision_leaves_that_of_the_reward() -> None:
    def precise(moment: Moment, spec: TaskSpec) -> Outcome:
        return Outcome({"height": moment.now.com[:, 1].double()})

    env = tiny(dataclasses.replace(hop(), reward_fn=precise), dtype="float32")
    env.reset(seed=0)
    _, reward, _, _, info = env.step(actions(env, 1)[0])
    assert reward.dtype == info["reward_terms"]["height"].dtype == torch.float32


@pytest.mark.parametrize("task", ["grow", "dig", "catch"])
def test_a_goal_that_is_replaced_is_rewarded_and_marked(task: str) -> None:
    spec = dittogym.make_spec(task)
    far = dataclasses.replace(spec, goal=(spec.goal[0] + 0.2, spec.goal[1]))
    results = []
    for each in (spec, far):
        env = tiny(each)
        observation = env.reset(seed=0)[0]
        results.append((observation, env.step(torch.zeros(1, *env.action_shape, dtype=env.dtype))[1]))
    assert not torch.equal(results[0][0], results[1][0]) and not torch.equal(results[0][1], results[1][1])


def test_a_target_that_is_replaced_is_rewarded() -> None:
    spec = dittogym.make_spec("shapematch")
    envs = [tiny(each) for each in (dataclasses.replace(spec, target=~spec.target), spec)]
    mismatch = []
    for env in envs:
        env.reset(seed=0)
        mismatch.append(float(env.step(actions(env, 1)[0])[-1]["reward_terms"]["mismatch"]))
    assert sum(mismatch) == pytest.approx(-0.1 * 64 * 64)  # each pixel differs from one of the two


@pytest.mark.parametrize(
    ("remembered", "error", "message"),
    [
        ("peak", TypeError, "initial_memory must be a function of a Moment and a TaskSpec, got 'peak'"),
        (lambda moment, spec: None, TypeError, "initial_memory of task 'hop' must return .* by name, got NoneType"),
        (lambda moment, spec: {"peak": 1.0}, ValueError, r"memory of shape \(B, ...\), got float for 'peak'"),
    ],
)
def test_memory_that_cannot_be_kept_is_refused(remembered: object, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        tiny(dataclasses.replace(hop(), initial_memory=remembered)).reset(seed=0)


def test_names_that_a_reset_cannot_leave_stale_are_refused() -> None:
    spec = dataclasses.replace(hop(), initial_memory=initial_peak, stale_memory=("summit",))
    with pytest.raises(ValueError, match=r"stale_memory names, got \['peak'\] without \['summit'\]"):
        tiny(spec).reset(seed=0)
    with pytest.raises(TypeError, match="stale_memory must be a sequence of str, got 'summit'"):
        dataclasses.replace(hop(), stale_memory="summit")


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_term_that_is_not_finite_is_named(value: float) -> None:
    def reward_fn(moment: Moment, spec: TaskSpec) -> Outcome:
        broken = torch.where(moment.now.com[:, 1] > 10.0, 0.0, value)
        return Outcome({"height": moment.now.split, "way": broken})

    env = tiny(dataclasses.replace(hop(), reward_fn=reward_fn, weights={"height": 1.0, "way": 1.0}), 2)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=f"must return finite terms .* got {value} for 'way' in simulation 0"):
        env.step(torch.zeros(2, *env.action_shape))
    env.state.x[0] = torch.nan  # a simulation that is not finite may be judged as it likes
    with pytest.raises(ValueError, match="for 'way' in simulation 1"):
        env.step(torch.zeros(2, *env.action_shape))


def test_the_fingerprint_is_that_of_the_task_s_file(tmp_path, monkeypatch) -> None:
    assert fingerprint("run") is None
    dittogym.register("hop", hop)
    assert fingerprint("hop") == hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
    space = {"dittogym": dittogym, "hop": hop}
    exec("def jump(): return dittogym.spec.TaskSpec(**{**vars(hop()), 'name': 'jump'})", space)
    dittogym.register("jump", space["jump"])
    assert fingerprint("jump") is None


def test_a_longer_limit_than_the_horizon() -> None:
    env = gymnasium.make("dittogym/shapematch-coarse-v0", max_episode_steps=32, particles=20, substeps=1)
    env.reset(seed=0)
    limits = [env.step(np.zeros(env.action_space.shape, np.float32))[3] for _ in range(32)]
    assert limits == [False] * 31 + [True]
    own = dittogym.Env("shapematch", particles=20, substeps=1)
    own.reset(seed=0)
    assert [own.step(np.zeros(own.action_space.shape, np.float32))[3] for _ in range(30)] == [False] * 29 + [True]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"terminated": torch.zeros(2, 2, dtype=torch.bool)}, r"terminated as bool of shape \(B,\), got torch.bool of"),
        ({"success": torch.zeros(2)}, r"success as bool of shape \(B,\), got torch.float32 of shape \(2,\)"),
        ({"terms": {"height": torch.zeros(3)}}, r"terms of shape \(B,\) .* of shape \(3,\) for 'height'"),
        (
            {"terms": {"height": torch.zeros(2) * 1j}},
            r"terms of shape \(B,\) in real numbers, got torch.complex64 of",
        ),
        ({"terms": {"alive": torch.zeros(2)}}, r"must not return the environment's own terms, got \['alive'\]"),
        ({"info": {"com": torch.zeros(2)}}, r"must not return the environment's own info, got \['com'\]"),
        ({"info": {"episode": torch.zeros(2)}}, r"must not return the environment's own info, got \['episode'\]"),
        ({"info": {"_risen": torch.zeros(2)}}, r"names that do not begin with _ or reward_terms/, got '_risen'"),
        ({"info": {"risen": 1.0}}, r"must return info of shape \(B, ...\), got float for 'risen'"),
        ({"memory": {"best": torch.zeros(2)}}, r"like that of initial_memory, {'first': .*got {'best': 'torch"),
        ({"memory": {"first": torch.zeros(2)}}, r"{'first': 'torch.float64 of shape \(2, 2\)'}, got {'first': 'torch"),
    ],
)
def test_an_outcome_that_would_do_harm_later_is_refused(changes: dict, message: str) -> None:
    def reward_fn(moment: Moment, spec: TaskSpec) -> Outcome:
        return height(moment, spec)._replace(**changes)

    spec = dataclasses.replace(
        hop(), reward_fn=reward_fn, initial_memory=lambda moment, spec: {"first": moment.now.com}
    )
    env = tiny(spec, 2)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step(actions(env, 1)[0])


def test_an_outcome_is_checked_in_every_step() -> None:
    """Also where the names are those of the step before."""
    width = 2
    spec = dataclasses.replace(
        hop(), reward_fn=lambda moment, spec: height(moment, spec)._replace(info={"risen": torch.zeros(width)})
    )
    env = tiny(spec, 2)
    env.reset(seed=0)
    env.step(actions(env, 1)[0])
    width = 1
    with pytest.raises(ValueError, match=r"must return info of shape \(B, ...\), got .* of shape \(1,\)"):
        env.step(actions(env, 1)[0])


def test_a_horizon_among_the_options_holds_through_gymnasium() -> None:
    dittogym.register("hop", hop)
    single = gymnasium.make("dittogym/hop-coarse-v0", horizon=3, **SMALL)
    batch = make_vec("hop", horizon=3)
    single.reset(seed=0)
    batch.reset(seed=0)
    ends = [single.step(np.zeros((2, 4, 4), np.float32))[3] for _ in range(3)]
    assert ends == [False, False, True]
    assert [batch.step(np.zeros((2, 2, 4, 4), np.float32))[3].tolist() for _ in range(3)][2] == [True, True]


def test_a_function_that_is_written_anew_takes_the_place_of_the_old_one() -> None:
    gymnasium.register("mine/hop-v0", "dittogym.env:Env", kwargs={"task": hop()})  # by hand, and left alone
    cell = "def jump(): return dittogym.spec.TaskSpec(**{**vars(hop()), 'name': 'jump', 'horizon': %d})"
    for horizon in (40, 20):
        names = {"dittogym": dittogym, "hop": hop, "__name__": "notebook"}
        exec(cell % horizon, names)
        dittogym.register("jump", names["jump"])
    assert gymnasium.spec("dittogym/jump-coarse-v0").max_episode_steps == 20 and "mine/hop-v0" in gymnasium.registry
    assert tiny("jump").spec.horizon == 20
    exec(cell % 10, names)
    dittogym.register("jump", names["jump"], version=1)
    assert "dittogym/jump-coarse-v1" in gymnasium.registry and "dittogym/jump-coarse-v0" not in gymnasium.registry


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"max_actuation": -5.0}, ValueError, "max_actuation must not be negative, got -5.0"),
        ({"goal": (1.0, 2.0, 3.0)}, ValueError, r"goal must be two numbers \(x, y\), got \(1.0, 2.0, 3.0\)"),
        ({"reach": (None, "up")}, ValueError, "reach y must be a number, got 'up'"),
        ({"reach": (None, 5.0)}, ValueError, r"reach must be 0 to 1 m from the lower left corner .* got \(None, 5.0\)"),
        ({"view": (-0.1, 0.5)}, ValueError, r"view must be 0 to 1 m from the lower left corner .* got \(-0.1, 0.5\)"),
        (
            {"target": np.zeros((3, 3), bool)},
            ValueError,
            r"target must be bool of shape \(64, 64\), got bool of shape \(3, 3\)",
        ),
        ({"weights": {"action": -2e-4}}, ValueError, r"weights\['action'\] must not be negative, got -0.0002"),
        ({"weights": 1.0}, TypeError, "weights must be a Mapping, got 1.0"),
        ({"obstacles": (VelocityRule("-y"),)}, TypeError, r"obstacles\[0\] must be a Obstacle, got VelocityRule"),
        ({"coarse": 16}, ValueError, "coarse must be at most fine, 8, got 16"),
        ({"obstacles": floor()}, TypeError, "obstacles must be a sequence of Obstacle, got Obstacle"),
    ],
)
def test_numbers_that_would_fail_late_are_refused(changes: dict, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        dataclasses.replace(hop(), **changes)


def test_a_robot_outside_its_window_is_refused() -> None:
    wide = BodySpec(Rectangle((0.9, 0.2), (0.3, 0.1)), count=100)
    with pytest.raises(ValueError, match="robot must lie inside the window"):
        tiny(dataclasses.replace(hop(), robot=wide, window=Window(left=0.0)))


def test_a_robot_inside_an_obstacle_is_refused() -> None:
    low = BodySpec(Rectangle((0.05, 0.1), (0.1, 0.1)), count=100)
    with pytest.raises(ValueError, match="robot must start outside the obstacle 'floor'"):
        tiny(dataclasses.replace(hop(), robot=low))


@pytest.mark.parametrize(
    ("shape", "obstacles", "message"),
    [
        (Disc((0.17, 0.02), 0.06), (floor(),), r"objects\[0\] must start outside the obstacle 'floor' .* 0.020 < y"),
        (Disc((0.7, 0.3), 0.1), (solid("box", (94, 98), (None, 60)),), r"objects\[0\] must start outside .* 'box'"),
        (Rectangle((0.9, 0.3), (0.2, 0.1)), (), r"objects\[0\] must lie inside the window .* got 0.900 < x < 1.100"),
    ],
)
def test_an_object_outside_its_window_or_in_an_obstacle_is_refused(shape, obstacles: tuple, message: str) -> None:
    spec = dataclasses.replace(hop(), objects=(BodySpec(shape, count=1000),))
    with pytest.raises(ValueError, match=message):
        tiny(dataclasses.replace(spec, obstacles=obstacles))


def test_a_robot_that_counts_as_torn_from_the_start_is_refused() -> None:
    with pytest.raises(ValueError, match="robot must be more compact"):
        tiny(dataclasses.replace(hop(), split_limit=0.05))


def test_a_robot_of_another_material_and_size() -> None:
    robot = dataclasses.replace(hop().robot, material=Elastic(1500.0, 50.0), lite=100)
    elastic = tiny(dataclasses.replace(hop(), robot=robot), particles="lite", substeps=20)
    own = tiny(hop(), particles=100, substeps=20)
    for env in (elastic, own):
        env.reset(seed=0)
        env.step(torch.ones(1, *env.action_shape, dtype=env.dtype))
    assert elastic.num_particles == 100
    assert (elastic.state.x - own.state.x).abs().max() > 1e-6


def test_constants_that_no_body_takes_are_refused() -> None:
    robot = dataclasses.replace(hop().robot, material=Elastic(1500.0, 50.0))
    env = tiny(dataclasses.replace(hop(), robot=robot))
    with pytest.raises(ValueError, match="physics may not hold 'mu' in hop, whose bodies have their own materials"):
        env.reset(seed=0, options={"physics": {"mu": 900.0}})
    env.reset(seed=0, options={"physics": {"mass": 2.0, "gravity": (0.0, -1.0)}})


def test_constants_that_only_the_object_takes_are_warned_of() -> None:
    robot = dataclasses.replace(dittogym.make_spec("kick").robot, material=Elastic(1500.0, 50.0))
    env = tiny("kick", body=robot)
    with pytest.warns(UserWarning, match=r"physics\['lam'\] changes the object of kick alone, not the robot") as caught:
        env.reset(seed=0, options={"physics": {"lam": 60.0}})
    assert len(caught) == 1 and caught[0].filename == __file__
    env.reset(seed=0, options={"physics": {"mass": 2.0}})


@pytest.mark.parametrize(
    ("part", "given", "kind"),
    [
        ("terms", torch.zeros(1), "torch.float32"),
        ("terms", None, "None"),
        ("memory", torch.zeros(1), "torch.float32"),
        ("info", [1], "list"),
        ("info", [], "list"),
    ],
)
def test_what_comes_without_names_is_refused(part: str, given: object, kind: str) -> None:
    env = tiny(
        dataclasses.replace(hop(), reward_fn=lambda moment, spec: height(moment, spec)._replace(**{part: given}))
    )
    env.reset(seed=0)
    with pytest.raises(TypeError, match=f"reward_fn of task 'hop' must return {part} by name, got {kind}"):
        env.step(torch.zeros(1, *env.action_shape))


def test_centres_of_windows_may_be_lists() -> None:
    assert dataclasses.replace(hop(), view=[None, 0.28]).view == (None, 0.28)


@pytest.mark.parametrize(
    ("task", "options"),
    [
        ("run", {"body": np.ones((9, 5), np.uint8) * 200, "dtype": torch.float64}),
        ("run", {"body": np.array([(0, 0), (4, 0), (4, 1), (0, 1)]), "device": torch.device("cpu")}),
        ("run", {"obstacles": (solid("box", i=(60, 66), j=(None, 24), friction=math.inf), floor(), ceiling(119))}),
        ("shapematch", {"target": dittogym.make_spec("shapematch", target="T").target}),
        ("run", {"body": Disc((0.1, 0.16), 0.15)}),
        ("run", {"body": Lattice((0.1, 0.16), (0.15, 0.15))}),
        ("run", {"body": Figure(np.tri(6, dtype=bool), (0.1, 0.16), 0.03)}),
        ("dig", {"body": BodySpec(Rectangle((-0.2, 0.5), (0.14, 0.14)), np.int16(900), 3.0, Elastic(300.0, 50.0))}),
        ("dig", {"body": BodySpec(Rectangle((-0.2, 0.5), (0.14, 0.14), draws=2), 900), "segment": np.int64(5)}),
        ("dig", {"body": BodySpec(Disc((-0.2, 0.5), 0.14), 900, material=Snow(300.0, 50.0, hardening_range=(1, 2)))}),
    ],
)
def test_an_environment_is_made_again_from_the_json_of_its_specification(task: str, options: dict) -> None:
    env = gymnasium.make(f"dittogym/{task}-coarse-v0", **SMALL, **options)
    same = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    models = [each.unwrapped.torch_env.model for each in (env, same)]
    assert models[0].constants == models[1].constants
    assert np.array_equal(env.reset(seed=0)[0], same.reset(seed=0)[0])
    gymnasium.make_vec(f"dittogym/{task}-coarse-v0", 2, **SMALL, **options).spec.to_json()


def test_what_json_cannot_write_of_a_body_is_refused() -> None:
    """A material that is learned, and a shape of one's own."""

    @dataclasses.dataclass(frozen=True)
    class Own(Disc):
        tilt: float = 0.0

    learned = BodySpec(Disc((0.1, 0.16), 0.15), 900, material=Elastic(torch.tensor(300.0), 50.0))
    with pytest.raises(TypeError, match="Tensor is not JSON serializable"):
        gymnasium.make("dittogym/run-coarse-v0", body=learned, **SMALL).spec.to_json()
    spec = gymnasium.make("dittogym/run-coarse-v0", body=Own((0.1, 0.16), 0.15), **SMALL).spec
    with pytest.raises(ValueError, match=r"kind of a body or an obstacle must be one of BodySpec.* got {'corner'"):
        gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(spec.to_json()))


def test_a_function_with_any_options_takes_them() -> None:
    def stretched(horizon: int = 30, **others: float):
        return dataclasses.replace(hop(), name="stretched", horizon=horizon, **others)

    dittogym.register("stretched", stretched)
    spec = dittogym.make_spec("stretched", horizon=40, mu=900.0)
    assert (spec.horizon, spec.mu) == (40, 900.0)
    with pytest.raises(TypeError, match="others"):  # of dataclasses.replace
        dittogym.make_spec("stretched", others=1.0)


def test_its_title_is_its_name() -> None:
    dittogym.register("hop", hop)
    assert headline("hop") == headline("module:hop") == ("hop", "")
    assert headline("shapematch") == ("SHAPE MATCH", "Take the shape of a picture, without gravity.")


def test_the_initial_memory_is_a_copy() -> None:
    env = tiny(dataclasses.replace(hop(), initial_memory=lambda moment, spec: {"start": moment.start.com}))
    env.reset(seed=0)
    env.env_state.memory["start"].zero_()
    assert env.env_state.start.com.any()

"""A task of one's own, registered without touching the library."""

import dataclasses
import math
import sys
from collections.abc import Iterator
from types import MappingProxyType

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3
from tiny import SMALL, actions, assert_same_bits, begun, everything, make_vec, tiny

import dittogym
from dittogym.bodies.shapes import Disc, Figure, Rectangle
from dittogym.geometry import Window, ceiling, floor, solid
from dittogym.rewards import Reward, Transition
from dittogym.spec import BodySpec, TaskSpec
from dittogym.tasks import headline
from torchmpm import Elastic, Snow


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
def height(transition: Transition, spec: TaskSpec) -> Reward:
    risen = transition.now.com[:, 1] - transition.start.com[:, 1]
    return Reward({"height": risen}, terminated=risen > 0.3, success=risen > 0.2)


def hop(pull: float = -5.0, horizon: int = 40, coarse: int = 4) -> TaskSpec:
    robot = BodySpec(Disc((0.4, 0.16), 0.18), count=5000)
    matter = {"mu": 500.0, "yield_stress": 80.0, "max_actuation": 60.0, "gravity": (0.0, pull)}
    world = {"obstacles": (floor(), ceiling(119)), "coarse": coarse, "fine": 8}
    weights = {"height": 7.0, "action": 1e-4, "alive": 1.0}
    return TaskSpec("hop", horizon, robot, reward_fn=height, weights=weights, **matter, **world)


def changed(**changes: object) -> TaskSpec:
    return dataclasses.replace(hop(), **changes)


def test_through_gymnasium_make_in_both_resolutions() -> None:
    dittogym.register("hop", hop)
    for resolution, size in (("coarse", 4), ("fine", 8)):
        name = f"dittogym/hop-{resolution}-v0"
        assert gymnasium.spec(name).max_episode_steps == 40
        env = gymnasium.make(name, **SMALL)
        assert env.action_space.shape == (2, size, size)
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
    assert terms["reward_terms/height"] == pytest.approx(7.0 * (info["com"][1] - start["com"][1]), abs=1e-6)
    assert reward == pytest.approx(sum(terms.values()), abs=1e-5)
    assert terminated is False and not info["is_success"]
    for lift, wanted in ((0.25, (False, True)), (0.1, (True, True))):
        env.unwrapped.state.x[..., 1] += lift
        _, _, terminated, _, info = env.step(still)
        assert (terminated, info["is_success"]) == wanted


def test_a_specification_needs_no_registration() -> None:
    check_env(dittogym.Env(hop(), particles=50, substeps=1), skip_render_check=True)
    batch = begun(dittogym.BatchEnv(hop(), 3, autoreset_mode="SameStep", **SMALL))
    batch.state.x[1, :, 1] += 0.35
    *_, terminated, _, info = batch.step(np.zeros((3, 2, 4, 4), np.float32))
    assert terminated.tolist() == [False, True, False] and info["final_info"]["is_success"][1]


def test_options_of_the_function_arrive() -> None:
    dittogym.register("hop", hop)
    env = gymnasium.make("dittogym/hop-coarse-v0", pull=-1.5, coarse=6, body=Disc((0.4, 0.16), 0.1), **SMALL)
    spec = env.unwrapped.torch_env.spec
    assert (spec.gravity, spec.robot.shape.size, env.action_space.shape) == ((0.0, -1.5), (0.1, 0.1), (2, 6, 6))
    single, batch = gymnasium.make("dittogym/hop-coarse-v0", horizon=3, **SMALL), make_vec("hop", horizon=3)
    single.reset(seed=0), batch.reset(seed=0)
    assert [single.step(np.zeros((2, 4, 4), np.float32))[3] for _ in range(3)] == [False, False, True]
    assert [batch.step(np.zeros((2, 2, 4, 4), np.float32))[3].tolist() for _ in range(3)][2] == [True, True]

    def stretched(horizon: int = 30, **others: float):
        return dataclasses.replace(hop(), name="stretched", horizon=horizon, **others)

    dittogym.register("stretched", stretched)
    spec = dittogym.make_spec("stretched", horizon=40, mu=900.0)
    assert (spec.horizon, spec.mu) == (40, 900.0)


def test_a_longer_limit_than_the_horizon() -> None:
    env = gymnasium.make("dittogym/shapematch-coarse-v0", max_episode_steps=32, particles=20, substeps=1)
    own = dittogym.Env("shapematch", particles=20, substeps=1)
    for each, limit in ((env, 32), (own, 30)):
        each.reset(seed=0)
        limits = [each.step(np.zeros(each.action_space.shape, np.float32))[3] for _ in range(limit)]
        assert limits == [False] * (limit - 1) + [True]


def test_the_horizon_of_a_specification_under_the_id_of_its_task() -> None:
    spec = dataclasses.replace(dittogym.make_spec("run"), horizon=3)
    single = gymnasium.make("dittogym/run-coarse-v0", task=spec, **SMALL)
    batch = gymnasium.make_vec("dittogym/run-coarse-v0", 1, vectorization_mode="vector_entry_point", task=spec, **SMALL)
    for each in (single, batch):
        each.reset(seed=0)
        assert [bool(each.step(np.zeros(each.action_space.shape, np.float32))[3]) for _ in range(3)] == [0, 0, 1]


def test_a_module_that_registers_the_task_is_imported_by_name(tmp_path, monkeypatch) -> None:
    """By ``MODULE:NAME``, and by a process that gets nothing but the specification of the environment as JSON."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "hopping.py").write_text(
        "import dataclasses, dittogym\n"
        "def leap(): return dataclasses.replace(dittogym.make_spec('run'), name='leap')\n"
        "dittogym.register('leap', leap)"
    )
    (tmp_path / "torn.py").write_text("\n1 / 0")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "hidden.py").write_text("raise AssertionError('is never imported')")
    assert tiny("hopping:leap", substeps=1).spec.name == "leap"
    text = gymnasium.spec("dittogym/leap-coarse-v0").to_json()
    del dittogym.TASKS["leap"], gymnasium.registry["dittogym/leap-coarse-v0"], sys.modules["hopping"]
    made = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(text), **SMALL)
    assert repr(made.unwrapped.torch_env) == "TorchEnv('leap', 1, 8, device='cpu')"
    for task, reason in (
        ("hopping:fly", "does not register 'fly'"),
        ("torn:leap", "ZeroDivisionError.*line 2 of .*torn.py"),
        ("missing_one:leap", "No module named 'missing_one'"),
        ("folder.hidden:leap", "without dots"),
        ("folder:fly", "does not register 'fly'"),
    ):
        with pytest.raises(ValueError, match=f"task must be .*{reason}"):
            dittogym.make_spec(task)


def test_a_task_of_a_module_is_not_another_one_of_its_name(tmp_path, monkeypatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    for module, horizon in (("first_hill", 5), ("second_hill", 6)):
        (tmp_path / f"{module}.py").write_text(
            "import dataclasses, dittogym\n"
            f"def hill(): return dataclasses.replace(dittogym.make_spec('run'), name='hill', horizon={horizon})\n"
            "dittogym.register('hill', hill)"
        )
        assert dittogym.make_spec(f"{module}:hill").horizon == horizon
    with pytest.raises(ValueError, match="module 'second_hill' has registered another 'hill' since"):
        dittogym.make_spec("first_hill:hill")


def test_names_and_files_of_tasks() -> None:
    dittogym.register("hop", hop)
    assert headline("hop") == headline("module:hop") == ("hop", "")
    assert headline("shapematch") == ("SHAPE MATCH", "Take the shape of a picture, without gravity.")


def test_the_later_registration_wins() -> None:
    """As when a cell of a notebook is run twice."""
    for horizon in (40, 20):
        dittogym.register("hop", lambda horizon=horizon: hop(horizon=horizon))
        assert gymnasium.spec("dittogym/hop-coarse-v0").max_episode_steps == horizon == tiny("hop").spec.horizon


def test_state_of_a_task_and_objects() -> None:
    """The highest point so far is remembered by each element until its own reset, in any kind of mapping."""

    def initial_peak(transition: Transition, spec: TaskSpec) -> MappingProxyType:
        return MappingProxyType({"peak": transition.start.com[:, 1]})

    def peak_reward(transition: Transition, spec: TaskSpec) -> Reward:
        peak = torch.maximum(transition.task_state["peak"], transition.now.com[:, 1])
        info = {"peak": peak, "stone": transition.object_com}
        return Reward({"peak": peak - transition.start.com[:, 1]}, info=info, task_state={"peak": peak})

    stone = BodySpec(Rectangle((0.7, 0.16), (0.06, 0.06)), count=500, mass=4.0)
    functions = {"initial_task_state": initial_peak, "reward_fn": peak_reward}
    spec = changed(objects=(stone,), weights={"peak": 7.0}, gravity=(0.0, 0.0), **functions)
    env = begun(tiny(spec, 2, particles=(100, 30)))
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
    env.reset(seed=0)
    env.env_state.task_state["peak"].zero_()  # a copy
    assert env.env_state.start.com.all()


def test_a_reset_that_fails_changes_nothing() -> None:
    working = True

    def remembered(transition: Transition, spec: TaskSpec) -> dict[str, torch.Tensor]:
        return {"start": transition.now.com} if working else {}["missing"]

    env, untouched = (begun(tiny(changed(initial_task_state=remembered), 2, resample=True)) for _ in range(2))
    before, working = everything(env), False
    for options in ({"physics": {"mu": 100.0}}, {"positions": env.state.x + 0.01}, {"reset_mask": [True, False]}):
        with pytest.raises(KeyError):
            env.reset(seed=[7, None], options=options)
    assert_same_bits(everything(env), before)
    working = True
    env.reset(), untouched.reset()
    assert_same_bits(everything(env), everything(untouched))


def test_a_term_in_double_precision_leaves_that_of_the_reward() -> None:
    def precise(transition: Transition, spec: TaskSpec) -> Reward:
        return Reward({"height": transition.now.com[:, 1].double()})

    env = begun(tiny(changed(reward_fn=precise), dtype="float32"))
    _, reward, _, _, info = env.step(actions(env, 1)[0])
    assert reward.dtype == info["reward_terms"]["height"].dtype == torch.float32


@pytest.mark.parametrize("task", ["grow", "dig", "catch", "shapematch"])
def test_a_goal_that_is_replaced_is_rewarded_and_marked(task: str) -> None:
    spec = dittogym.make_spec(task)
    other = {"target": ~spec.target} if spec.goal is None else {"goal": (spec.goal[0] + 0.2, spec.goal[1])}
    images, rewards = [], []
    for each in (spec, dataclasses.replace(spec, **other)):
        env = tiny(each)
        images.append(env.reset(seed=0)[0])
        rewards.append(env.step(torch.zeros(1, *env.action_shape, dtype=env.dtype))[1])
    assert torch.equal(*images) is (spec.goal is None) and not torch.equal(*rewards)


def test_a_robot_of_another_material() -> None:
    """Constants that no body takes are refused; of those that the object alone takes there is a warning."""
    robot = dataclasses.replace(hop().robot, material=Elastic(1500.0, 50.0), lite=100)
    elastic, own = tiny(changed(robot=robot), particles="lite", substeps=20), tiny(hop(), particles=100, substeps=20)
    for env in (elastic, own):
        env.reset(seed=0)
        env.step(torch.ones(1, *env.action_shape, dtype=env.dtype))
    assert (elastic.state.x - own.state.x).abs().max() > 1e-6
    with pytest.raises(ValueError, match="physics may not hold 'mu'"):
        elastic.reset(seed=0, options={"physics": {"mu": 900.0}})
    elastic.reset(seed=0, options={"physics": {"mass": 2.0, "gravity": (0.0, -1.0)}})
    kick = tiny("kick", body=dataclasses.replace(dittogym.make_spec("kick").robot, material=Elastic(1500.0, 50.0)))
    with pytest.warns(UserWarning, match=r"physics\['lam'\] changes the object of kick alone") as caught:
        kick.reset(seed=0, options={"physics": {"lam": 60.0}})
    assert [each.filename for each in caught] == [__file__]


@pytest.mark.parametrize(
    ("task", "options"),
    [
        ("run", {"body": np.ones((9, 5), np.uint8) * 200, "dtype": torch.float64}),
        ("run", {"body": np.array([(0, 0), (4, 0), (4, 1), (0, 1)]), "device": torch.device("cpu")}),
        ("run", {"obstacles": (solid("box", i=(60, 66), j=(None, 24), friction=math.inf), floor(), ceiling(119))}),
        ("shapematch", {"target": dittogym.make_spec("shapematch", target="T").target}),
        ("run", {"body": Figure(np.tri(6, dtype=bool), (0.1, 0.16), 0.03)}),
        ("dig", {"body": BodySpec(Rectangle((-0.2, 0.5), (0.14, 0.14)), np.int16(900), 3.0, Elastic(300.0, 50.0))}),
        ("dig", {"body": BodySpec(Disc((-0.2, 0.5), 0.14), 900, material=Snow(300.0, 50.0, hardening_range=(1, 2)))}),
    ],
)
def test_an_environment_is_made_again_from_the_json_of_its_specification(task: str, options: dict) -> None:
    env = gymnasium.make(f"dittogym/{task}-coarse-v0", **SMALL, **options)
    same = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert np.array_equal(env.reset(seed=0)[0], same.reset(seed=0)[0])
    same.unwrapped.load(env.unwrapped.save())  # fits
    gymnasium.make_vec(f"dittogym/{task}-coarse-v0", 2, **SMALL, **options).spec.to_json()


def test_a_batch_is_made_again_from_the_json_of_its_specification() -> None:
    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    batch = gymnasium.make_vec("dittogym/run-coarse-v0", 2, autoreset_mode=mode, **SMALL)
    same = gymnasium.make_vec(gymnasium.envs.registration.EnvSpec.from_json(batch.spec.to_json()))
    assert (same.num_envs, same.metadata) == (2, batch.metadata)


def test_centres_may_be_lists_and_a_fixed_window_may_lie_anywhere() -> None:
    spec = changed(view=[None, 0.28], window=Window(left=0.1))
    assert spec.view == (None, 0.28)
    env = begun(tiny(spec))
    assert env.env_state.origin.tolist() == [[0.1, 0.0]]

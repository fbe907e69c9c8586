"""Bad images, policies, checkpoints and files of options."""

import json
import struct
import zlib
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from bad_cases import TINY, Case, Refused, command, prepared, table
from policy_files import write_stranger

import baselines.registry
import cfp
import cfp.evaluate
import cfp.train
from baselines.modular.learner import ModularConfig
from cfp.agent.actor import ActorSpec
from cfp.errors import CheckpointError
from cfp.policy import read_policy
from cfp.train import from_python
from dittogym import make_spec

FIELDS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def png(width, height, rows=b""):
    """A PNG that says how large it is, with any content."""

    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def picture(grey):
    return cv2.imencode(".png", np.asarray(grey, np.uint8))[1].tobytes()


def target(name, content, *words):
    """A picture as the target of SHAPE MATCH and, by the same reader, as a robot."""
    call = prepared(
        lambda desk: desk.file("picture.png", content),
        lambda desk: make_spec("shapematch", target=desk.folder / "picture.png"),
    )
    return Case(f"image {name}", call, ("target", *words))


IMAGES = [
    Case("image missing", lambda desk: make_spec("shapematch", target="no.png"), ("target", "no.png")),
    target("of text", "hello", "cannot be read as an image"),
    target("all white", picture(np.full((64, 64), 255)), "pixels of the shape and of the ground, got 4096 of 4096"),
    target("that would fill the memory", png(10_000, 10_000), "at most 4194304 pixels, got 10000 x 10000"),
    target("that would fill any memory", png(2**31 - 1, 2**31 - 1), "cannot be read as an image"),
]


def policy(name, *words, content=None, load=cfp.load, **laid):
    """A policy file of a stranger."""

    def prepare(desk):
        if content is None:
            desk.policy(**laid)
        else:
            desk.file("stranger.safetensors", content)

    call = prepared(prepare, lambda desk: load(desk.folder / "stranger.safetensors"))
    return Case(f"policy {name}", call, ("stranger.safetensors: ", *words), CheckpointError)


def header(values, data=b""):
    """A safetensors file with a header of one's own."""
    text = json.dumps(values).encode()
    return struct.pack("<Q", len(text)) + text + data


def first(change):
    """Do something to the first tensor."""

    def weights(tensors):
        name = next(iter(tensors))
        return {**tensors, name: change(tensors[name])}

    return weights


SHIPPED = (cfp.policy.SHIPPED / "run.safetensors").read_bytes()
HUGE = {"x": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}

POLICIES = [
    Case("policy missing", lambda desk: cfp.load("nobody"), ("nobody: there is no", "grow-success"), CheckpointError),
    *(
        Case(f"policy {path!r}", lambda desk, path=path: cfp.load(path), ("path must", repr(path)), CheckpointError)
        for path in (None, 5, b"run", "", "hf://runner", "hf://a/b/c", "hf://a/b@", "hf://a/b@../../x y")
    ),
    *table((f"policy onto {to!r}", lambda to=to: cfp.load("run", device=to), "device") for to in ("abacus", 1.5)),
    *table((f"policy into {to!r}", lambda to=to: cfp.load("run").save(to), "path") for to in ("run", "run.json")),
    *table((f"run of {given!r}", lambda given=given: cfp.Run(given), "folder") for given in (None, "")),
    policy("of text", "damaged", content="hello, I am a policy"),
    policy("cut short", "damaged", content=SHIPPED[: len(SHIPPED) // 2]),
    policy("with a header of terabytes", "damaged", content=struct.pack("<Q", 2**42) + b"{}"),
    policy("with a tensor of terabytes", "damaged", content=header(HUGE)),
    policy("without a description", "description must be that of a cfp-policy", content=header({})),
    policy("with a deep description", "damaged", content=header({"__metadata__": {"cfp-policy": "[" * 99_999}})),
    policy("of another version", "cfp-policy of version 1", changes={"version": 2}),
    policy("of another kind", "kind must be", "'mpc'", changes={"kind": "mpc"}),
    policy("of a task by number", "task must be of type str, got 3", changes={"task": 3}),
    policy("of no grid", "resolution must be between 1 and 128, got 0", changes={"resolution": 0}),
    policy("of stage -1", "stage must be between 1 and", changes={"stage": -1}),
    policy("for an unknown environment", "colour is not an option", changes={"environment": {"colour": 1}}),
    policy("without a network", "do not match", changes={"network": {}}),
    policy("with an unknown network", "do not match", "colour is not an", changes={"network": {"colour": 1}}),
    policy("with a grid of 7", "resolutions must be increasing values of", changes={"network": {"resolutions": [7]}}),
    policy("with a patch of a mile", "and 128, got 1000", changes={"network": {"resolutions": [8], "patch": 10**6}}),
    policy("with a negative gate", "gate_scale must", changes={"network": {"resolutions": [8], "gate_scale": -1.0}}),
    policy("of NaN", "got NaN or infinity", weights=first(lambda tensor: tensor * float("nan"))),
    policy("of other shapes", "do not match", "size mismatch", weights=first(lambda tensor: tensor[..., :1])),
    policy(
        "with a tensor too many", "do not match", "extra", weights=lambda tensors: {**tensors, "extra": torch.zeros(1)}
    ),
    policy(
        "of segments without number",
        "do not match",
        load=baselines.load,
        changes={
            "kind": "gnn-16",
            "network": {"kind": "gnn", "features": 10**12},
            "nodes": {"count": 10**9, "graph": 1},
        },
    ),
    policy("of actions that are none", "do not match", load=baselines.load, changes={"kind": "gradient"}),
    Case(
        "policy of alchemy",
        prepared(
            lambda desk: desk.policy({"kind": "alchemy"}),
            lambda desk: baselines.load(desk.folder / "stranger.safetensors"),
        ),
        ("algo must be one of cfp-analytic",),
    ),
]


NETWORKS = [
    *table(
        (f"network with {given}", partial(ActorSpec, **{"resolutions": (8, 16), "gate_bias": (0.0,)} | given), words)
        for given, words in (
            ({"resolutions": (16, 8)}, "resolutions must be increasing"),
            ({"resolutions": ()}, "resolutions must be increasing"),
            ({"gate_bias": ()}, "gate_bias must have 1 values"),
            ({"gate_scale": float("nan")}, "gate_scale must be positive, got nan"),
            ({"encoder": "large"}, "encoder must be paper or small, got 'large'"),
            ({"interpolation": "bilinear"}, "interpolation must be half_pixel or aligned, got 'bilinear'"),
        )
    ),
    *table(
        (f"segments of {algo}", ModularConfig(task="kick", algo=algo).check, ("algo", repr(algo)))
        for algo in ("gnn", "gnn-x", "mlp-16", "gnn-1")
    ),
]


def training_options(algo, *rows):
    """Options of a training of RUN, as `cfp.fit` reads them."""
    return table(
        (f"{algo}, {words[0]}", partial(from_python, {"task": "run", "algo": algo} | options, None, False), words)
        for options, *words in rows
    )


OPTIONS = [
    *training_options(
        "cfp-analytic",
        ({"gama": 0.9}, "gama is not an option"),
        ({"particles": "few"}, "particles must be of type", "got 'few'"),
        ({"handover": ()}, "handover must have 1 values"),
        ({"steps": 96, "num_envs": 2, "window": 32, "handover": (0.5,)}, "every stage at least 64 steps"),
        ({"alpha": (1.0, 1.0)}, "alpha is not an option"),  # of the other learner only
        ({"warmup": 3, "task": "nowhere"}, "task must be", "got 'nowhere'"),
        ({"window": 0}, "window must be at least 1, got 0"),
        ({"action_step": [0.0]}, "action_step must be positive, got 0"),
        ({"weight_average": 1.0}, "weight_average must be at least 0 and less than 1"),
        ({"num_layouts": 9_999}, "num_layouts must be at most 9992"),
        ({"vary_start": 0.0}, "vary_start requires vary"),
        ({"train_dt": 3e-4}, "train_dt must divide an environment step of 0.01 s"),
    ),
    *training_options(
        "cfp-sac",
        ({"steps": True}, "steps must be of type int"),
        ({"video": 1}, "video must be of type bool"),
        ({"tau": "0.5"}, "tau must be of type float"),
        ({"dtype": "float16"}, "dtype must be of type Literal['float32', 'float64']"),
        ({"particles": [1.5, 2]}, "particles must be of type"),
        ({"alpha": [0.1, "x"]}, "alpha must be of type tuple[float, ...]"),
        ({"noise_scale": [1.0, 2.0, 3.0]}, "noise_scale must be of type"),
        ({"gate_bias": [10**400]}, "gate_bias must be below 2**63"),
        ({"steps": 0}, "steps must be at least 1, got 0"),
        ({"num_envs": 10_001}, "num_envs must be at most 10000"),
        ({"resolutions": []}, "resolutions must have at least one value"),
        ({"resolutions": [4, 8, 16]}, "handover must have 2 values"),
        ({"handover": [1.0]}, "handover must be shares of the steps between 0 and 1"),
        ({"resolutions": [4, 8, 16], "handover": [0.5, 0.4]}, "steps and handover must give every stage"),
        ({"steps": 20}, "steps and handover must give every stage at least 16 steps"),
        ({"critics_first": [1.0]}, "critics_first must be at least 0 and less than 1, got 1"),
        ({"noise_cells": 3}, "noise_cells must be one of"),
        ({"noise_cells": 8}, "noise_cells must be at most 4"),
        ({"noise_scale": [0.0, 1.0]}, "noise_scale must be positive"),
        ({"n_steps": 0}, "n_steps must be at least 1, got 0"),
        ({"gamma": 1.0}, "gamma must be below 1 with several n_steps"),
        ({"buffer_size": 20}, "buffer_size must be at least batch_size"),
        ({"refine": True}, "refine requires start_from"),
        ({"vary": 1.5}, "vary must be between 0 and 1, got 1.5"),
        ({"vary_latency": -1}, "vary_latency must be at least 0, got -1"),
        ({"vary_noise": -0.1}, "vary_noise must be at least 0, got -0.1"),
        ({"vary_actions": 1.1}, "vary_actions must be between 0 and 1, got 1.1"),
        ({"vary_pixels": -0.1}, "vary_pixels must be between 0 and 1, got -0.1"),
        ({"vary_physics": 1.0}, "vary_physics must be at least 0 and less than 1, got 1.0"),
        ({"vary_start": -1.0}, "vary_start must be at least 0, got -1.0"),
    ),
]


FITS = table(
    (f"fit with {options}", partial(cfp.fit, "run", **options), words)
    for options, words in (
        ({"out": ""}, "out must name a folder, got ''"),
        ({"out": b"run"}, "out must name a folder, got b'run'"),
        ({"out": Path(__file__)}, "out must be a folder, got the file"),
        ({"resume": "x", "out": "new"}, "resume"),
        ({"on_evaluation": 3, "out": "new"}, "on_evaluation"),
    )
)
PRESETS = table(
    (f"preset {' '.join(words)}", partial(cfp.preset, "run", *words), named)
    for words, named in ((("paper", "cfp-analytic"), "preset"), (("quick", "ppo"), "algo"), (("slow",), "preset"))
)


def resumed(name, change, *words):
    """A run whose folder was changed before it is resumed."""
    call = prepared(lambda desk: desk.run(change), command(cfp.train.main, TINY + " --resume --out {folder}/run"))
    return Case(f"run with {name}", call, words, Refused, leaves="run/tensorboard/")


def evaluated(name, change, *words):
    """A run whose folder was changed before it is evaluated."""
    call = command(cfp.evaluate.main, "{folder}/run --episodes 1 --device cpu")
    return Case(f"evaluated run with {name}", prepared(lambda desk: desk.run(change), call), words, Refused)


def write(name, content):
    return lambda folder: (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def cut(name):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:-200])


def options(**changes):
    def change(folder):
        path = folder / "config.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return change


def state(**changes):
    """Another value in the checkpoint; None takes it out."""

    def change(folder):
        path = folder / "checkpoint" / "state.pt"
        content = torch.load(path, weights_only=True) | changes
        torch.save({name: value for name, value in content.items() if value is not None}, path)

    return change


def described(**changes):
    """Another description of the policy."""

    def change(folder):
        path = folder / "policy.safetensors"
        tensors, description = read_policy(path)
        write_stranger(path, tensors, description | changes)

    return change


class Stranger:
    """What a file of pickles could hold."""


def chunk_outside(folder):
    path = folder / "checkpoint" / "state.pt"
    content = torch.load(path, weights_only=True)
    content["chunks"][0]["file"] = "../../../secret.npz"
    torch.save(content, path)


def chunk_of_objects(folder):
    path = next((folder / "checkpoint" / "replay").iterdir())
    np.savez(path, **dict.fromkeys(FIELDS, np.array([Stranger()], object)))


RUNS = [
    resumed("a checkpoint cut short", cut("checkpoint/state.pt"), "state.pt: the checkpoint is damaged"),
    resumed(
        "a checkpoint that runs code",
        lambda folder: torch.save({"version": 4, "x": Stranger()}, folder / "checkpoint" / "state.pt"),
        "state.pt: the checkpoint is damaged (UnpicklingError)",
    ),
    resumed("a checkpoint of version 99", state(version=99), "checkpoint version must be 4, got 99"),
    resumed("a checkpoint without a model", state(learner=None), "does not fit this program", "learner"),
    resumed("a checkpoint before its time", state(offset=-5), "does not fit this program", "negative"),
    resumed("a checkpoint of stage 8", state(stage=8), "does not fit this program", "it is of stage 8"),
    resumed("a checkpoint of another task", state(config='{"task": "run"}'), "task: the run was started with 'run'"),
    resumed("a chunk outside", chunk_outside, "chunks must be files in this folder, got '../../../secret.npz'"),
    resumed("a chunk of objects", chunk_of_objects, "this part of the replay buffer is missing or damaged"),
    resumed("broken options", write("config.json", "{"), "config.json: cannot be read"),
    evaluated("no options", lambda folder: (folder / "config.json").unlink(), "there is no run (no config.json)"),
    evaluated("unknown options", options(colour=1), "config.json: colour is not an option"),
    evaluated("no policy", lambda folder: (folder / "policy.safetensors").unlink(), "no policy has been written yet"),
    evaluated("a policy for another task", described(task="run"), "policy.safetensors: stage 1 of this run", "for run"),
    evaluated("a policy of another grid", described(resolution=16), "stage 1 of this run", "a grid of 16"),
    evaluated("a policy cut short", cut("policy.safetensors"), "policy.safetensors: the policy is damaged"),
]


def file_of_options(name, content, *words, main=cfp.train.main, option="config"):
    """A JSON file."""
    arguments = f"--{option} {{folder}}/options.json --out {{folder}}/run --dry-run"
    call = prepared(lambda desk: desk.file("options.json", content), command(main, arguments))
    return Case(f"{option} file {name}", call, words, Refused)


CONFIGS = [
    file_of_options("broken", '{"steps": 3,}', "config: options.json cannot be read as JSON", "line 1"),
    file_of_options("in another encoding", b"\xff\xfe{\x00}\x00", "options.json cannot be read", "utf-8"),
    file_of_options("nested too deeply", "[" * 99_999, "options.json cannot be read as JSON (it is nested too deeply)"),
    file_of_options("too large", " " * (2**20 + 1), "options.json cannot be read", "larger than 1048576 bytes"),
    file_of_options("of a list", "[1]", "cannot be read as JSON (it must hold an object, got list"),
    file_of_options("with an unknown name", '{"stepz": 1}', "stepz is not an option"),
    file_of_options("with steps as text", '{"steps": "x"}', "steps must be of type int, got 'x'"),
    file_of_options("with a rate of NaN", '{"learning_rate": NaN}', "learning_rate must be finite,"),
    file_of_options("with a rate of 400 digits", f'{{"tau": 1{"0" * 400}}}', "tau must be below 2**63"),
    file_of_options("with steps of 401 digits", f'{{"steps": 1{"0" * 400}}}', "steps must be below 2**63"),
    Case(
        "config file missing",
        command(cfp.train.main, "--config no.json --out run --dry-run"),
        ("config: no.json cannot be read", "No such file"),
        Refused,
    ),
    Case(
        "config file never ends",
        command(cfp.train.main, "--config /dev/zero --out run --dry-run"),
        ("config: /dev/zero cannot be read as JSON (it is not a file)",),
        Refused,
    ),
]

CASES = [*IMAGES, *POLICIES, *NETWORKS, *OPTIONS, *FITS, *PRESETS, *RUNS, *CONFIGS]

"""Bad command lines of every program."""

import json

from bad_cases import TINY, Case, Refused, command, prepared

import baselines.compare.__main__ as compare
import baselines.distill
import baselines.evaluate
import baselines.leaderboard
import baselines.robustness
import baselines.train
import cfp.evaluate
import cfp.train

NEW = " --out {folder}/new "
ROBUSTNESS = baselines.robustness.main


def training(name, options, *words, main=cfp.train.main):
    return Case(f"train with {name}", command(main, TINY + NEW + options), words, Refused)


def learning(algo, name, options, *words):
    common = f"--algo {algo} --particles 100 --substeps 1 --eval-episodes 1 --no-video --device cpu"
    return Case(f"{algo} with {name}", command(baselines.train.main, common + NEW + options), words, Refused)


def distilling(name, options, *words):
    common = "--particles 100 --substeps 1 --train-particles 100 --eval-episodes 1 --no-video --device cpu"
    return Case(f"distill with {name}", command(baselines.distill.main, common + NEW + options), words, Refused)


def evaluating(name, options, *words, main=cfp.evaluate.main):
    return Case(f"evaluate {name}", command(main, "--device cpu " + options), words, Refused)


def comparing(name, options, *words):
    return Case(f"compare {name}", command(compare.main, options + NEW), words, Refused)


def ranking(name, options, *words):
    return Case(f"rank {name}", command(baselines.leaderboard.main, options + NEW), words, Refused)


def planned(name, plan, *words):
    call = command(compare.main, "--plan {folder}/plan.json --dry-run" + NEW)
    return Case(f"plan {name}", prepared(lambda desk: desk.file("plan.json", json.dumps(plan)), call), words, Refused)


TRAIN = [
    training("an unknown task", "--task swim", "task must be one of catch, dig"),
    training(
        "an unknown preset",
        "--preset slow",
        "preset must be one of quick, long, paper for shapematch, got 'slow'",
    ),
    training("an unknown option", "--colour red", "Unrecognized options: --colour"),
    training("a seed by name", "--seed x", "Error parsing --seed: invalid literal for int()", "'x'"),
    training("seed -1", "--seed -1", "seed must be between 0 and 2147483647, got -1"),
    training("no particles", "--particles 0", "particles must be at least 1 for every body, got 0"),
    training("batches of one", "--batch-size 1", "batch_size must be at least 2, got 1"),
    training(
        "steps of 401 digits",
        f"--steps 1{'0' * 400}",
        "steps must be below 2**63, got a number of 401 digits",
    ),
    training("steps and a half", "--steps 1.5", "Error parsing --steps", "'1.5'"),
    training(
        "a late handover",
        "--resolutions 4 8 --random-steps 9 9 --handover 50",
        "steps and handover must give every stage at least",
        "got stages of 50, -30 steps",
    ),
    training("a grid of 5", "--resolutions 5", "resolutions must be increasing values of (4, 8,"),
    training("a negative temperature", "--alpha -1", "alpha must be at least 0, got -1.0"),
    training("a temperature that is no number", "--alpha nan", "alpha must be finite, got (nan,)"),
    training("a gate without scale", "--gate-scale 0", "gate_scale must be positive, got 0.0"),
    training("an anchor to nothing", "--anchor 3", "anchor requires refine"),
    training("an unknown backend", "--backend warp", "backend must be one of ('auto', 'eager'", "got 'warp'"),
    training("a target that is not there", "--target none.png", "target must be 'star'", "no such file: 'none.png'"),
    training("a variant of another task", "--variant published", "task 'shapematch' got an unexpected", "'variant'"),
    training("a policy that is not there", "--start-from none", "none.safetensors: there is no policy"),
    training("a policy of another task", "--start-from run", "start_from must be a policy for shapematch, got one"),
    training("an algorithm of baselines", "--algo shac", "algo must be 'cfp', got 'shac'; python -m baselines.train"),
    training("robots on judging layouts", "--num-envs 10001", "num_envs must be at most 10000, got 10001"),
    training("a buffer smaller than a batch", "--buffer-size 1", "buffer_size must be at least batch_size, 4, got 1"),
    Case(
        "train with a memory of years",
        command(cfp.train.main, TINY + NEW + "--buffer-size 99999999999999", 1),
        ("not enough memory", "buffer_size"),
        Refused,
        leaves="new",
    ),
    Case(
        "train into a file",
        prepared(lambda desk: desk.file("new", "mine"), command(cfp.train.main, TINY + NEW)),
        ("out must be a folder, got the file new",),
        Refused,
    ),
    Case(
        "train into a run",
        prepared(lambda desk: desk.run(), command(cfp.train.main, TINY + " --out {folder}/run")),
        ("out: run already holds a run",),
        Refused,
    ),
    Case(
        "train under a file",
        prepared(lambda desk: desk.file("new", "mine"), command(cfp.train.main, TINY + " --out {folder}/new/run")),
        ("out: new/run cannot be created as a folder (Not a directory)",),
        Refused,
    ),
    training("a folder under /proc", "--out /proc/run", "out: /proc/run cannot be created as a folder (No such file"),
    Case(
        "train into a link in a loop",
        prepared(lambda desk: desk.link("loop"), command(cfp.train.main, TINY + " --out {folder}/loop")),
        ("out: loop cannot be created as a folder (File exists)",),
        Refused,
    ),
    training("a folder that is not text", "--out run\udcff", "error: out must be text in UTF-8, got 'run\\udcff'"),
    training("an unset variable as its folder", "--out ''", "error: out must name a folder, got ''"),
    training("a variable that is not set", "--out=", "error: out must name a folder, got ''"),
    training("an option without its value", "--task", "Missing value for argument '--task"),
    training("noise of more cells than actions", "--noise-cells 32", "noise_cells must be at most"),
]

OTHERS = [
    learning("alchemy", "gold", "", "algo must be one of cfp, analytic, coarse, fine, gnn-16", "got 'alchemy'"),
    learning("coarse", "two grids", "--resolutions 4 8", "resolutions must have one value, got (4, 8)"),
    learning("gnn-16", "ten particles", "--particles 10", "particles of the robot must be at least 16", "got 10"),
    learning("gnn-16", "a negative temperature", "--alpha -1", "alpha must be at least 0, got -1.0"),
    learning("gradient", "no iterations", "--iterations 0", "iterations must be at least 1, got 0"),
    learning("gradient", "a grid of 99", "--grid 99", "grid must be 'coarse', 'fine' or 1 to 64, got 99"),
    learning("gradient", "a fine grid of 0", "--polish 1 --polish-grid 0", "polish_grid must be 'coarse', 'fine' or"),
    learning("distill", "no particles", "--train-particles 0", "error: train_particles: particles must be at least 1"),
    learning("distill", "plans on 99", "--teacher mpc --planner-grid 99", "planner_grid must be 'coarse', 'fine' or"),
    learning("mpc", "two robots", "--num-envs 2", "num_envs", "got 2"),
    learning("mpc", "no horizon", "--horizon 0", "horizon must be at least 1, got 0"),
    learning("mpc", "a horizon before its end", "--horizon 2 --commit 3", "commit", "got 3"),
    learning("cem", "one elite", "--elites 1", "elites", "got 1"),
    learning("shac", "an endless discount", "--gamma nan", "gamma must be finite, got nan"),
    learning("shac", "a policy of the state", "--start-from run", "start_from", "sees 'image'"),
    learning(
        "gradient", "a target of another task", "--task run --target T", "task 'run' got an unexpected", "'target'"
    ),
    learning("gradient", "a blur of rewards", "--task run --blur 1", "blur requires ", "the reward of shapematch"),
    distilling("plans of no planner", "--iterations 9", "iterations requires teacher mpc"),
    learning("zero", "training", "", "'zero' is a reference policy", "torchmpm compare --algos zero"),
    distilling("a teacher of another task", "--teacher run", "teacher must be a policy for shapematch, got one for"),
    learning("coarse", "another learner", "--learner analytic", "learner must be sac for algo coarse, got analytic"),
    learning("analytic", "another learner", "--learner sac", "learner must be analytic for algo analytic, got sac"),
    learning("analytic", "positions drawn anew", "--resample", "resample requires soft actor-critic"),
    learning("shac", "judging layouts", "--num-layouts 50000", "num_layouts must be at most 9996, got 50000"),
    distilling("judging layouts", "--num-layouts 5000", "num_layouts must be at most 4992, got 5000"),
    distilling("no labels", "--capacity 0", "capacity must be at least 1, got 0"),
    evaluating("nothing", "", "either policy or a folder must be given, got neither"),
    evaluating("the name of a policy as a folder", "run", "there is no such folder; --policy run names the policy"),
    evaluating("a file below a file", "--policy run --record /dev/null/a.npz", "record: ", "a.npz cannot be written"),
    evaluating("the size of no film", "--policy run --size 100", "size requires a file that ends in .gif or "),
    evaluating("the zoom of a replay", "--policy run --replay a.html --zoom 3", "zoom requires a file that ends in "),
    evaluating("a folder that is not there", "{folder}/none", "none: there is no run (no config.json)"),
    evaluating("an unknown policy on film", "--policy alchemy --video new/a.webp", "no shipped one has that name"),
    evaluating("an unknown policy", "--policy alchemy", "no shipped one has that name (catch, dig, grow, "),
    evaluating("no episodes", "--policy run --episodes 0", "episodes must be at least 1, got 0"),
    evaluating(
        "episodes of 401 digits",
        f"--policy run --episodes 1{'0' * 400}",
        "episodes must be below 2**63, got a number of 401 digits",
    ),
    evaluating("a policy and a folder", "{folder} --policy run", "either policy or a folder must be given"),
    evaluating(
        "a policy on an abacus",
        "--policy run --device abacus",
        "device must be 'cpu' or 'cuda', got 'abacus'; auto chooses one",
    ),
    evaluating("an empty folder", "{folder}", "there is no run", main=baselines.evaluate.main),
    evaluating("a disturbed nothing", "{folder}", "there is no run", main=ROBUSTNESS),
    evaluating(
        "under an earthquake",
        "--policy run --out {folder}/new --cases earthquake",
        "cases must be words of action dropout 20%",
        main=ROBUSTNESS,
    ),
    evaluating(
        "without most actions",
        "{folder} --dropout 1.5",
        "dropout must be above 0 and below 1, got 1.5",
        main=ROBUSTNESS,
    ),
    evaluating("under noise of NaN", "{folder} --action-noise nan", "action_noise must be positive", main=ROBUSTNESS),
    evaluating("on ice that pushes", "{folder} --friction -1", "friction must be at least 0", main=ROBUSTNESS),
    evaluating("disturbed, nowhere", "--policy run", "out must be given with a single policy", main=ROBUSTNESS),
    Case("compare into an unset variable", command(compare.main, "--out ''"), ("must name a folder, got ''",), Refused),
    evaluating("disturbed, into an unset variable", "--policy run --out ''", "must name a folder", main=ROBUSTNESS),
    comparing("unknown tasks", "--tasks swim", "task must be one of catch"),
    comparing("unknown algorithms", "--algos alchemy", "alchemy on shapematch: algo must be one of"),
    comparing("a seed twice", "--seeds 1 1", "seeds must be one or more different values, got 1 1"),
    comparing("parts of a GPU at home", "--gpus-per-run 0.5", "gpus_per_run requires --executor ray, got 0.5"),
    ranking("a policy that is not there", "none", "none.safetensors: there is no policy"),
    ranking("a file that is not there", "none.json", "none.json: cannot be read as JSON"),
    comparing("a plan that is not there", "--plan none.json", "plan: none.json cannot be read"),
    planned("of a list", [1], "plan: plan.json cannot be read as JSON (it must hold an object, got list"),
    planned("of other parts", {"colour": 1}, "must hold common, tasks and algos only, got colour"),
    planned("with a seed of its own", {"common": {"seed": 5}}, "plan: common must not hold seed"),
    planned("with a device in a task", {"algos": {"cfp": {"tasks": {"run": {"device": "cpu"}}}}}, "plan: algos.cfp.t"),
    planned("with unknown options", {"common": {"colour": 1}}, "analytic on shapematch", "--colour"),
    planned("with a task of its own", {"algos": {"mpc": {"target": "T"}}}, "plan: algos.mpc must not hold target"),
]

CASES = [*TRAIN, *OTHERS]

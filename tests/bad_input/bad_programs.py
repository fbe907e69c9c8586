"""Bad command lines of every program: options, and what the error line must name."""

import json
from importlib import import_module

from bad_cases import TINY, Case, Refused, command, prepared

from cfp.policy import SHIPPED

NEW = " --out {folder}/new "
RUN = f"{SHIPPED}/run.safetensors"
SMALL = "--particles 100 --substeps 1 --eval-episodes 1 --no-video --device cpu"
#: Algorithms whose resets are all seeded.
SEEDED = ("cfp-analytic", "shac", "gradient", "mpc", "cem", "distill")
PROGRAMS = {
    "train": ("cfp.train", TINY + NEW),
    "learn": ("baselines.train", SMALL + NEW),
    "distill": ("baselines.train", "--algo distill " + SMALL + " --train-particles 100" + NEW),
    "evaluate": ("cfp.evaluate", "--device cpu "),
    "disturb": ("cfp.robustness", "--device cpu "),
    "compare": ("baselines.compare.__main__", NEW),
    "rank": ("baselines.leaderboard", NEW),
}


def main_of(module):
    """The entry of a program, which is imported when it is called."""
    return lambda arguments: import_module(module).main(arguments)


def rows(program, *table):
    module, common = PROGRAMS[program]
    return [
        Case(f"{program} {options or 'nothing'}", command(main_of(module), common + options), tuple(words), Refused)
        for options, *words in table
    ]


def laid(name, prepare, options, *words, module="cfp.train", code=2, leaves="nothing"):
    """A command in a folder that holds something already."""
    return Case(name, prepared(prepare, command(main_of(module), options, code)), words, Refused, leaves)


def planned(plan, *words):
    options = "--plan {folder}/plan.json --dry-run" + NEW
    return laid(
        f"plan {plan}",
        lambda desk: desk.file("plan.json", json.dumps(plan)),
        options,
        *words,
        module="baselines.compare.__main__",
    )


def started(options, *words):
    """A training that starts from the policy of a run."""
    start = " --start-from {folder}/run "
    return laid(f"train after a run {options}", lambda desk: desk.run(), TINY + NEW + start + options, *words)


#: Environments of policies that are not those of the programs.
FASTER, TARGET = {"environment": {"substeps": 50}}, {"environment": {"target": "T", "substeps": 1}}


def stranger(program, options, changes, *words, name="stranger"):
    """A policy of RUN whose description says something else, as the last argument of a program."""
    module, common = PROGRAMS[program]
    return laid(
        f"{program} of a stranger: {words[0]}",
        lambda desk: desk.policy(changes, name=name),
        f"{common} {options} {{folder}}/{name}.safetensors",
        *words,
        module=module,
    )


TRAIN = [
    *rows(
        "train",
        ("--task swim", "task must be one of catch, dig"),
        ("--preset slow", "preset must be", "'slow'"),
        ("--colour red", "--colour"),
        ("--seed x", "--seed", "'x'"),
        (f"--steps 1{'0' * 400}", "steps must be below 2**63, got a number of 401 digits"),
        ("--steps 1.5", "--steps", "'1.5'"),
        ("--task", "'--task"),
        ("--learner ppo", "--learner", "'ppo'"),
        ("--seed -1", "seed must be between 0 and 2147483647, got -1"),
        ("--alpha nan", "alpha must be finite"),
        ("--particles 0", "particles must be at least 1, got 0"),
        ("--resolutions 5", "resolutions must be increasing values of (4, 8,"),
        ("--backend warp", "backend must be one of", "'warp'"),
        ("--target none.png", "target must be 'star'", "'none.png'"),
        ("--variant published", "'shapematch'", "'variant'"),
        ("--start-from none", "none: there is no policy"),
        ("--start-from run", "start_from must be a policy for shapematch"),
        ("--out /proc/run", "out: /proc/run cannot be created as a folder"),
        ("--out run\udcff", "out must be text in UTF-8"),
        ("--out ''", "out must name a folder, got ''"),
        ("--out=", "out must name a folder, got ''"),
    ),
    laid(
        "memory of years",
        lambda desk: None,
        TINY + NEW + "--buffer-size 99999999999999",
        "buffer_size",
        code=1,
        leaves="new",
    ),
    laid("train into a file", lambda desk: desk.file("new", "mine"), TINY + NEW, "out must be a folder, got the file"),
    laid("train into a run", lambda desk: desk.run(), TINY + " --out {folder}/run", "out: run already holds a run"),
    laid("train under a file", lambda desk: desk.file("new", "mine"), TINY + " --out {folder}/new/run", "out: new/run"),
    started("", "must be a policy of the first resolutions of (4,), but not all of them without refine, got (4,)"),
    started("--refine --resolutions 8 16", "start_from must be a policy of the first resolutions of (8, 16)"),
    started("--refine --encoder paper", "start_from must be a policy with encoder paper, got small"),
    started("--target T", "start_from must be a policy for the target T, got the default"),
    laid("resume nothing", lambda desk: None, "--resume --out {folder}/none", "none holds no run to resume; name a"),
    laid("train into a loop", lambda desk: desk.link("loop"), TINY + " --out {folder}/loop", "out: loop cannot be"),
]

OTHERS = (
    rows(
        "learn",
        ("--algo alchemy", "algo must be one of cfp-analytic, cfp-sac, coarse", "'alchemy'"),
        ("--algo zero", "algo: 'zero' is a reference policy"),
        ("--algo nowhere:Own", "algo: nowhere:Own cannot be imported", "No module named 'nowhere'"),
        ("--algo os:path", "algo must name a subclass of cfp.learner.Learner", "'os:path'"),
        ("--algo os.path:join", "algo must be one of", "'os.path:join'"),
        ("--algo coarse --learner analytic", "learner must not be given"),
        ("--algo gnn-16 --particles 10", "particles of the robot must be at least 16", "got 10"),
        ("--task kick --algo gnn-64 --particles 63 100", "particles of the robot must be at least 64", "got 63"),
        ("--algo gnn-16 --alpha -1", "alpha must be at least 0, got -1.0"),
        ("--algo gradient --iterations 0", "iterations must be at least 1, got 0"),
        ("--algo gradient --grid 99", "grid must be", "got 99"),
        ("--algo gradient --window -1", "window must be at least 0, got -1"),
        ("--algo gradient --polish-learning-rate 0", "polish_learning_rate must be positive, got 0"),
        ("--algo gradient --blur 1 -1", "blur must be one or more numbers, none of them negative, got (1.0, -1.0)"),
        ("--algo gradient --polish 1 --polish-grid 0", "polish_grid must be"),
        ("--algo gradient --task dig --target T", "'dig'", "'target'"),
        ("--algo distill --train-particles 0", "train_particles: particles must be at least 1"),
        ("--algo distill --beta-decay 1.5", "beta_decay must be between 0 and 1, got 1.5"),
        ("--algo distill --dropout -0.1", "dropout must be between 0 and 1, got -0.1"),
        ("--algo distill --updates 0", "updates must be at least 1, got 0"),
        ("--algo distill --learning-rate 0", "learning_rate must be positive, got 0"),
        ("--algo distill --rollout-steps 90000", "steps and handover must give every stage at least"),
        ("--algo mpc --num-envs 2", "num_envs", "got 2"),
        ("--algo mpc --horizon 0", "horizon must be at least 1, got 0"),
        ("--algo mpc --horizon 2 --commit 3", "commit", "got 3"),
        ("--algo mpc --iterations 0", "iterations must be positive, got 0"),
        ("--algo mpc --noise -0.1", "noise must be at least 0, got -0.1"),
        ("--algo cem --elites 1", "elites", "got 1"),
        ("--algo cem --elites 33", "elites", "got 33"),
        ("--algo cem --initial-std 0", "initial_std must be positive, got 0"),
        ("--algo cem --noise-correlation 1", "noise_correlation must be", "got 1.0"),
        ("--algo shac --gamma nan", "gamma must be finite"),
        ("--algo shac --gamma 1.5", "gamma must be between 0 and 1, got 1.5"),
        ("--algo shac --learning-rate 0", "learning_rate must be positive, got 0"),
        ("--algo shac --split-margin -0.5", "split_margin must be at least 0, got -0.5"),
        ("--algo shac --start-from run", "start_from"),
        ("--algo shac --num-layouts 50000", "num_layouts must be at most"),
        *((f"--algo {algo} --resample", "resample must be False") for algo in SEEDED),
        ("--algo cfp-analytic --vary-latency 3", "vary_latency requires vary"),
        ("--task grow --vary 0.5 --vary-start 20 --dry-run", "conditions must leave the robot room"),
    )
    + rows(
        "distill",
        ("--teacher run", "teacher must be a policy for shapematch"),
        ("--teacher none", "teacher must be shac, gradient, catch, dig, "),
        ("--num-layouts 5000", "num_layouts must be at most"),
    )
    + rows(
        "evaluate",
        ("", "either policy or a folder must be given, got neither"),
        ("{folder} --policy run", "either policy or a folder must be given"),
        ("run", "there is no such folder; --policy run names the policy"),
        (RUN, "run.safetensors names the policy"),
        ("{folder}/none", "none: there is no run (no config.json)"),
        ("{folder}", "there is no run"),
        ("--policy alchemy", "no shipped one has that name"),
        ("--policy alchemy --video new/a.webp", "no shipped one has that name"),
        ("--policy run --record /dev/null/a.npz", "record: "),
        ("--policy alchemy --record a.h5", "record must end in .npz, got a.h5"),
        ("--policy alchemy --record-fields x", "record_fields requires record"),
        ("--policy alchemy --video a.html", "video must end in .mp4 or .gif or .webp or .png, got a.html"),
        ("--policy alchemy --replay a.mp4", "replay must end in .html, got a.mp4"),
        ("--policy alchemy --video a.mp4 --size 3", "size must be at least 16, got 3"),
        ("--policy run --dt 3e-4", "dt must divide an environment step"),
        ("--policy run --dt 0", "dt must be positive"),
        ("--policy run --size 100", "size requires a file"),
        ("--policy run --replay a.html --zoom 3", "zoom requires a file"),
        ("--policy run --episodes 0", "episodes must be at least 1, got 0"),
        (f"--policy run --episodes 1{'0' * 400}", "episodes must be below 2**63"),
        ("--policy run --device abacus", "device must be 'cpu' or 'cuda', got 'abacus'"),
    )
    + rows(
        "disturb",
        ("{folder}", "there is no policy"),
        ("", "policies must be one or more, got none"),
        ("alchemy", "no shipped one has that name"),
        ("run --cases earthquake", "cases must be words of"),
        ("run --episodes 0", "episodes must be at least 1, got 0"),
        ("run --rows {folder}", "rows: "),
    )
    + rows(
        "compare",
        ("--out ''", "must name a folder"),
        ("--tasks swim", "task must be one of catch"),
        ("--algos alchemy", "algo must be one of cfp-analytic"),
        ("--seeds 1 1", "seeds must be one or more different values"),
        ("--seeds 9500 --algos mpc", "seeds must be between 0 and 8999, got 9500"),
        ("--algos ../zero", "algos must be names without a path, got '../zero'"),
        ("--only 0 --report-only", "only cannot be combined with --report-only"),
        ("--gpus-per-run 0.5", "gpus_per_run requires --executor ray"),
        ("--address head:6379", "address requires --executor ray, got head:6379"),
        ("--executor ray --workers 2", "workers requires --executor local"),
        ("--plan none.json", "plan: none.json cannot be read"),
    )
    + rows(
        "rank",
        ("", "policies must be one or more, got none"),
        ("none", "none: there is no policy"),
        ("none.json", "none.json: cannot be read as JSON"),
        ("zero --tasks swim", "task must be one of"),
    )
    + [
        laid(
            "evaluations in another table",
            lambda desk: desk.file("other.csv", "step,mean\n1,2\n"),
            "run --rows {folder}/other.csv --device cpu",
            "rows: other.csv must be a table with the columns protocol, task",
            module="cfp.robustness",
        ),
        stranger("learn", "--algo distill --task run --teacher", TARGET, "teacher: cannot compare its target"),
        stranger("disturb", "", FASTER, "stranger.safetensors must be a policy for environment steps of 0.01 s"),
        stranger("disturb", RUN, {"steps": 1}, "names of their own, got two called 'run' on run", name="run"),
        stranger("rank", "", FASTER, "environment steps of 0.01 s, got 0.005"),
        stranger("rank", RUN, {"steps": 1}, "names of their own, got two called 'run' on run", name="run"),
        laid(
            "policy of a damaged comparison",
            lambda desk: (desk.policy(), desk.file("comparison.json", "{")),
            NEW + "{folder}/stranger.safetensors",
            "comparison.json: cannot be read",
            module="baselines.leaderboard",
        ),
        planned([1], "plan: plan.json cannot be read as JSON"),
        planned({"colour": 1}, "must hold common, tasks and algos only, got colour"),
        planned({"common": {"seed": 5}}, "plan: common must not hold seed"),
        planned({"algos": {"mine": {"algo": "mpc", "target": "M"}}}, "plan: algos.mine must not hold target"),
        planned({"algos": {"cfp-sac": {"tasks": {"run": {"device": "cpu"}}}}}, "plan: algos.cfp-sac.t"),
        planned({"common": {"colour": 1}}, "cfp-analytic on shapematch", "colour"),
        planned({"algos": {"zero": {"steps": 5}}}, "steps must not be under algos.zero, which is not trained"),
    ]
)

CASES = [*TRAIN, *OTHERS]

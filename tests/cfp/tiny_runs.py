"""Trainings of seconds: robots of a hundred particles that move one substep at a time."""

from cfp import train

COMMON = (
    "--task shapematch --particles 100 --substeps 1 --num-envs 2 --resolutions 4 8 --eval-episodes 2 "
    "--checkpoint-every 20 --log-every 10 --no-video --device cpu"
)
TINY = (
    f"{COMMON} --learner sac --steps 150 --handover 0.4667 --random-steps 10 4 --batch-size 4 --buffer-size 60 "
    "--update-start 8 --critics-first 0 --gradient-steps 1 --eval-every 60"
).split()
TINY_ANALYTIC = (
    f"{COMMON} --learner analytic --steps 96 --handover 0.5 --window 4 --minibatches 2 --minibatch-size 4 "
    "--windows-kept 2 --warmup 1 --train-particles 100 --max-episode-steps 6 --eval-every 40"
).split()
OF_LEARNER = {"sac": TINY, "analytic": TINY_ANALYTIC}
#: Options of `TINY` for one stage.
ONE_STAGE = "--resolutions 4 --handover --random-steps 10 --eval-every 0 --eval-episodes 1".split()
TABLES = ("progress.csv", "evaluations.csv", "results.json")


def run(folder, *more, learner="sac"):
    return train.main([*OF_LEARNER[learner], "--out", str(folder), *more])


def resume(folder, *more):
    return train.main(["--out", str(folder), "--resume", *more])


def assert_same_run(folder, other, tables=(*TABLES, "policy.safetensors")):
    for name in tables:
        assert (folder / name).read_bytes() == (other / name).read_bytes(), name

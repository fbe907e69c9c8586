"""Command lines: options, help, ``--dry-run``, exit codes and error lines, warnings before a training."""

import dataclasses
import io
import json
import os
import re
import signal
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import baselines.train
from cfp import registry, train
from cfp.config import to_json
from cfp.errors import CheckpointError, ConfigError, NonFiniteError
from cfp.experiment.cli import Stopped, program_name, run_command
from cfp.presets import sac_preset
from cfp.train import parse

TINY = "--learner sac --particles 100 --substeps 1 --num-envs 2 --device cpu --steps 400 --batch-size 4".split()


def test_command_line_beats_file_beats_preset(tmp_path):
    file = tmp_path / "options.json"
    file.write_text(json.dumps({"task": "run", "algo": "cfp-sac", "gamma": 0.5, "tau": 0.25, "video": True}))
    command = parse(["--config", str(file), *"--gamma 0.75 --no-video --particles 500 20 --out x".split()])
    own = {"gamma": 0.75, "tau": 0.25, "video": False, "particles": (500, 20)}
    assert command.run == replace(sac_preset("run"), **own) and command.out == Path("x")
    assert parse(["--particles", "full"]).run.particles == "full"
    assert parse(["--task", "run"]).out == Path("runs/cfp-analytic-run-quick-0")
    assert parse("--task run --learner sac --seed 4".split()).out == Path("runs/cfp-sac-run-quick-4")
    assert parse("--preset paper --task dig".split()).run == sac_preset("dig", "paper")


def test_the_folder_to_resume_follows_from_the_options_that_name_it(tmp_path, monkeypatch):
    """Also from a seed of zero where the preset has another."""
    monkeypatch.chdir(tmp_path)
    words = "--task catch --preset paper --algo cfp-sac".split()
    begun = replace(parse(words).run, steps=400_000)
    assert begun.seed == 2
    (tmp_path / "runs/cfp-sac-catch-paper-2").mkdir(parents=True)
    (tmp_path / "runs/cfp-sac-catch-paper-2/config.json").write_text(json.dumps(to_json(begun)))
    for option, seed, steps in (([], 2, 400_000), (["--seed", "2"], 2, 400_000), (["--seed", "0"], 0, 380_000)):
        command = parse([*words, *option, "--resume"])
        assert (command.run.seed, command.run.steps) == (seed, steps)
        assert command.out == Path(f"runs/cfp-sac-catch-paper-{seed}")


def test_dry_run_prints_the_options_and_writes_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert train.main([*TINY, "--dry-run"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert registry.configure(printed) == parse(TINY).run
    assert (printed["steps"], printed["handover"], printed["particles"]) == (400, [0.75], 100)
    assert train.main([*TINY, "--task", "run", "--resume", "--dry-run"]) == 0
    assert json.loads(capsys.readouterr().out)["task"] == "run"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", ["--task dig", "--task slot --learner sac", "--algo gnn-16", "--algo shac"])
def test_help_shows_each_option_once_with_its_description_and_the_task_s_own_value(words, capsys):
    config = parse(words.split(), "baselines.train").run
    with pytest.raises(SystemExit):
        baselines.train.main([*words.split(), "--help"])
    shown = capsys.readouterr().out
    lines = [line.strip("│| ") for line in shown[shown.index("-h, --help") :].splitlines()]
    entries = " ".join(f"\n{line}" if re.match("--[a-z]", line) else line for line in lines).splitlines()[1:]
    names = [entry.split()[0].strip("-,").replace("-", "_") for entry in entries]
    own = [option.name for option in dataclasses.fields(config)]
    assert sorted(names) == sorted([*own, "learner", "out", "resume", "config", "dry_run"])
    for name, entry in zip(names, entries, strict=True):
        assert re.search(r"[A-Za-z]+ [a-z]+.*\(default: ", entry), f"{name} is not described"
        if name in own:
            value = getattr(config, name)
            told = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
            assert f"(default: {told})" in entry
    assert "Algorithms: cfp-analytic, cfp-sac" in shown


def test_help_names_the_program_that_was_started(monkeypatch, capsys):
    monkeypatch.setattr(sys.modules["__main__"], "__spec__", None)  # as in a script
    monkeypatch.setattr(sys, "argv", ["pit.py", "--out", ".", "--bad"])
    with pytest.raises(SystemExit):
        train.main()
    assert "python pit.py --help" in " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert program_name("cfp.train", []) == "python -m cfp.train"


@pytest.mark.parametrize(
    ("words", "lines"),
    [
        ("--handover 0.5", ["stage 1: all its 200 steps are random", "stage 2: no update in its 200 steps"]),
        ("--random-steps 9 0 --update-start 50", []),
        ("--algo cfp-analytic --task run --steps 6000", ["stage 2: only the critic learns in its 1,500 steps"]),
        ("--algo cfp-analytic --task run --steps 9000", []),
    ],
)
def test_stages_that_learn_nothing_are_named(words, lines, tmp_path):
    config = parse(words.split() if "algo" in words else [*TINY, *words.split()]).run
    for first in (1, 2):
        told = registry.find(config.algo).warnings(config, tmp_path, first)
        assert [line.split(" (")[0] for line in told] == [line for line in lines if first == 1 or "stage 2" in line]


def run_raising(error):
    """Exit code of a program that raises an error."""

    def command():
        raise error

    return run_command(command)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (ConfigError("steps: got 0"), 2),
        (CheckpointError("state.pt: damaged"), 2),
        (NonFiniteError("the loss became nan"), 1),
        (OSError("No space left on device"), 1),
        (MemoryError("backend"), 1),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), 1),
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"), 1),
    ],
)
def test_expected_error_is_one_line_and_an_exit_code(capsys, error, code):
    assert run_raising(error) == code
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith("error: ") and captured.err.count("\n") == 1
    assert str(error) in captured.err


def test_exit_codes_of_programs_that_end_stop_or_fail(capsys):
    assert run_command(lambda: None) == 0 and run_command(lambda: 1) == 1
    assert run_raising(Stopped(signal.SIGTERM, "resume with: the same command")) == 128 + signal.SIGTERM
    assert capsys.readouterr().out == "stopped by SIGTERM; resume with: the same command\n"
    assert run_raising(KeyboardInterrupt()) == 130
    with pytest.raises(RuntimeError, match="a mistake"):  # keeps its traceback
        run_raising(RuntimeError("a mistake in the program"))


def test_output_that_nobody_reads_any_more_is_no_error(monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as output:  # buffered, as that of a program in a pipe
        monkeypatch.setattr(sys, "stdout", output)
        assert run_command(lambda: print("a few words")) == 141


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_letters_that_the_output_lacks_are_escaped(encoding, monkeypatch):
    output = io.TextIOWrapper(io.BytesIO(), encoding)
    monkeypatch.setattr(sys, "stdout", output)
    assert run_command(lambda: print("→ \udce4")) == 0  # the latter stands for a byte of a file name
    assert output.buffer.getvalue() == b"\\u2192 \\udce4\n"


def test_a_program_needs_no_output(monkeypatch, capsys):
    """As after ``>&-`` and ``2>&-`` in a shell; the latter's words do not go elsewhere."""
    monkeypatch.setattr(sys, "stderr", None)
    assert run_command(lambda: print("for a person", file=sys.stderr)) == 0
    assert capsys.readouterr().out == ""
    sys.stderr.close()
    monkeypatch.setattr(sys, "stdout", None)
    assert run_command(lambda: print("a few words")) == 0

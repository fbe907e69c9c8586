"""The console command ``torchmpm``."""

import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import dittogym
from baselines import console

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def own_arguments(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["torchmpm"])


def output_of(capsys, *words):
    """Exit code and output of a command; a program's help ends with ``SystemExit``."""
    try:
        code = console.main(words)
    except SystemExit as stop:
        code = stop.code or 0
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_help_is_quick_because_it_imports_no_program():
    program = "import sys; from baselines import console; console.main(['--help']); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    text, _, modules = done.stdout.rstrip().rpartition("\n")
    assert all(f"\n  {name} " in text for name in console.PROGRAMS) and "Examples:" in text
    assert not {"torch", "numpy", "tyro", "gymnasium"} & set(modules.split())


@pytest.mark.parametrize("name", [*console.PROGRAMS, "train --algo shac"])
def test_every_program_is_started_under_its_name_with_examples(name, capsys):
    code, text, _ = output_of(capsys, *name.split(), "--help")
    started = f"torchmpm {name.split()[0]}"
    assert code == 0 and text.startswith(f"usage: {started} ") and f"Examples:\n  {started} " in text
    assert ("--td-lambda" in text) == name.startswith("train")


def test_help_shows_what_is_trained_first(capsys):
    _, text, _ = output_of(capsys, "train", "--task", "kick", "--help")
    shown = re.findall(r"^[│ ] --([a-z-]+)", text, re.MULTILINE)
    position = {name: shown.index(name) for name in ("task", "algo", "preset", "seed", "num-envs", "eval-every")}
    assert sorted(position, key=position.__getitem__) == list(position)


def test_options_and_exit_codes_reach_the_program_and_the_shell(tmp_path, capsys):
    code, text, error = output_of(capsys, "train", "--task", "run", "--steps", "0")
    assert (code, text) == (2, "") and error.startswith("error: steps must")
    file = tmp_path / "cem.json"
    file.write_text('{"algo": "cem", "task": "run"}')
    of_file, cem = ("--config", str(file)), ("--algo=cem", "--out", str(tmp_path / "r"))
    for words, algo in ((cem, "cem"), (of_file, "cem"), ((), "cfp-analytic"), (("--preset", "long"), "cfp-sac")):
        code, text, _ = output_of(capsys, "train", "--task", "run", *words, "--dry-run")
        assert code == 0 and json.loads(text)["algo"] == algo


def test_no_program_shows_the_help_and_a_wrong_one_the_choice(capsys):
    assert output_of(capsys) == output_of(capsys, "-h") and console.main([]) == 0
    capsys.readouterr()
    code, text, error = output_of(capsys, "tarin")
    assert (code, text) == (2, "") and error.startswith("error: PROGRAM must be one of train, ")


def test_tasks_of_the_working_directory_are_found(tmp_path, monkeypatch, capsys):
    (tmp_path / "strolling.py").write_text(
        "import dataclasses, dittogym\n"
        "dittogym.register('stroll', lambda: dataclasses.replace(dittogym.make_spec('run'), name='stroll'))\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    code, text, _ = output_of(capsys, "train", "--task", "strolling:stroll", "--dry-run")
    dittogym.TASKS.pop("stroll")
    assert code == 0 and json.loads(text)["task"] == "strolling:stroll"


MODULES = (
    *(f"cfp.{name}" for name in ("train", "evaluate", "robustness", "play")),
    *(f"baselines.{name}" for name in ("train", "compare", "leaderboard")),
)


@pytest.mark.parametrize("module", MODULES)
def test_every_program_is_a_module(module, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [module, "--help"])
    for loaded in (module, f"{module}.__main__"):  # else runpy warns that it is there already
        monkeypatch.delitem(sys.modules, loaded, raising=False)
    with pytest.raises(SystemExit) as stop:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    assert not stop.value.code and f"usage: python -m {module}" in capsys.readouterr().out


def test_the_version_is_the_same_everywhere(capsys):
    texts = {name: (ROOT / name).read_text() for name in ("pyproject.toml", "CITATION.cff", "torchmpm/__init__.py")}
    patterns = (r'^version = "(.*)"$', r"^version: (.*)$", r'^__version__ = "(.*)"$')
    (version,) = {
        re.search(pattern, text, re.MULTILINE)[1] for pattern, text in zip(patterns, texts.values(), strict=True)
    }
    assert output_of(capsys, "--version")[1] == f"torchmpm {version}\n"

"""Policies on the hub, with the calls of huggingface_hub answered from memory; nothing reaches a network."""

import hashlib
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import pytest
import torch

import baselines
import cfp
from cfp import hub
from cfp.agent.actor import ActorSpec
from cfp.evaluate import Command
from cfp.policy import ActorPolicy

huggingface_hub = pytest.importorskip("huggingface_hub")
REPO = "someone/runner"


class Server:
    """One repository: the folder of each commit, the newest last, and how it was created."""

    def __init__(self, folder):
        self.folder, self.commits, self.created = folder, [], None

    def create_repo(self, repo_id, *, private, exist_ok):
        if "/" not in repo_id:
            raise ValueError(f"{repo_id} is no name")
        self.created = repo_id, private

    def upload_folder(self, *, repo_id, folder_path, commit_message):
        return self.commit({file.name: file.read_bytes() for file in Path(folder_path).iterdir()})

    def commit(self, files):
        content = b"".join(files.values())
        commit = self.folder / hashlib.sha1(content).hexdigest()
        commit.mkdir(parents=True, exist_ok=True)
        for name, value in files.items():
            (commit / name).write_bytes(value)
        self.commits.append(commit)
        return SimpleNamespace(oid=commit.name)

    def hf_hub_download(self, repo_id, filename, *, revision):
        if repo_id != REPO:
            raise OSError("404")
        commit = self.commits[-1] if revision in (None, "main") else self.folder / revision
        return str(commit / filename)


@pytest.fixture
def server(monkeypatch, tmp_path):
    server = Server(tmp_path / "hub")
    for name in ("create_repo", "upload_folder", "hf_hub_download"):  # with the parameters of the real ones
        answer = mock.create_autospec(getattr(huggingface_hub, name), side_effect=getattr(server, name))
        monkeypatch.setattr(huggingface_hub, name, answer)
    hub.download.cache_clear()
    yield server
    hub.download.cache_clear()


@pytest.fixture(scope="module")
def policy():
    return cfp.load("kick")


def same(policy, other):
    mine, theirs = policy.state_dict(), other.state_dict()
    return mine.keys() == theirs.keys() and all(torch.equal(mine[name], theirs[name]) for name in mine)


def test_pushed_policy_comes_back_and_its_address_is_printed(server, policy, capsys):
    rows = [{"policy": "stage 1", "episodes": 5, "mean": 8376.25, "std": 10.0}]
    address = policy.push(REPO, results=rows, private=True)
    (commit,) = server.commits
    assert address == f"hf://{REPO}@{commit.name}"
    assert {file.name for file in commit.iterdir()} == {"README.md", "policy.json", "policy.safetensors"}
    assert server.created == (REPO, True)
    card = (commit / "README.md").read_text()
    for text in ("library_name: torchmpm", f'cfp.load("hf://{REPO}")', "kick", "| stage 1 | 5 | 8,376.2 |"):
        assert text in card, text
    loaded = cfp.load(f"hf://{REPO}")
    assert same(loaded, policy) and loaded.description == policy.description
    assert address in capsys.readouterr().err
    assert cfp.load(f"hf://{REPO}") and capsys.readouterr().err == ""  # not downloaded twice


def test_address_of_a_commit_stays_what_it_was(server, policy):
    first, other = policy.push(REPO), cfp.load("run")
    second = other.push(REPO)
    assert same(cfp.load(first), policy) and same(cfp.load(second), other)
    assert same(cfp.load(f"hf://{REPO}@main"), other)


def test_policies_of_other_algorithms_and_programs_take_addresses(server, policy):
    wave = baselines.OpenLoop(torch.rand(5, 2, 8, 8), policy.description | {"kind": "mpc"})
    wave.push(REPO)
    assert "baselines.load(" in (server.commits[-1] / "README.md").read_text()
    assert torch.equal(baselines.load(f"hf://{REPO}").actions, wave.actions)
    config, policies = Command(policy=policy.push(REPO)).open()
    assert config.task == "kick" and same(policies["policy"], policy)


def test_run_pushes_its_results(server, finished):
    address = cfp.Run(finished).push(REPO)
    assert "| stage 2 | 2 |" in (server.commits[-1] / "README.md").read_text()
    assert same(cfp.load(address), cfp.load(finished))


def test_what_the_hub_refuses_is_one_error(server, policy):
    with pytest.raises(cfp.CheckpointError, match="hf://someone/else: cannot be downloaded"):
        cfp.load("hf://someone/else")
    with pytest.raises(cfp.ConfigError, match="repo"):
        policy.push("no name")
    with pytest.raises(cfp.ConfigError, match="policy must come from a run"):
        ActorPolicy(ActorSpec((8,))).push(REPO)


def test_missing_package_is_named(policy, monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    for use in (lambda: policy.push(REPO), lambda: cfp.load(f"hf://{REPO}@missing")):
        with pytest.raises(cfp.ConfigError, match=r"pip install 'torchmpm\[hub\]'"):
            use()

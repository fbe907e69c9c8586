"""Policies on the hub, against a local server that speaks its HTTP interface; nothing reaches a network."""

import base64
import hashlib
import json
import sys
import threading
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote

import pytest
import torch

import baselines
import cfp
from cfp import hub
from cfp.agent.actor_policy import ActorPolicy
from cfp.agent.spec import ActorSpec
from cfp.evaluate import Selection
from cfp.train import PROGRAM
from cfp.weights import policy_file

pytestmark = pytest.mark.usefixtures("short")

huggingface_hub = pytest.importorskip("huggingface_hub")
REPO = "someone/runner"


class Hub(ThreadingHTTPServer):
    """Repositories in memory: the files of each commit, and branches."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self.server_port}"
        self.created, self.commits, self.head = [], {}, ""

    def commit(self, files):
        """Add a commit on top of the branch main, and return its hash."""
        content = self.commits.get(self.head, {}) | files
        self.head = hashlib.sha1(repr(sorted(content.items())).encode()).hexdigest()
        self.commits[self.head] = content
        return self.head


class Handler(BaseHTTPRequestHandler):
    """What `create_repo`, `upload_folder` and `snapshot_download` ask for."""

    protocol_version = "HTTP/1.1"

    def log_message(self, *arguments):
        """Be quiet."""

    def reply(self, value, status=200, headers=()):
        body = value if isinstance(value, bytes) else json.dumps(value).encode()
        self.send_response(status)
        for name, text in (*headers, ("Content-Length", str(len(body)))):
            self.send_header(name, text)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def files_of(self, revision):
        server = self.server
        commit = server.head if revision == "main" else revision
        return commit, server.commits.get(commit)

    def do_GET(self):
        words = unquote(self.path.partition("?")[0]).strip("/").split("/")
        if words[:2] == ["api", "models"]:
            revision = words[words.index("revision") + 1] if "revision" in words else "main"
            revision = words[words.index("tree") + 1] if "tree" in words else revision
            commit, files = self.files_of(revision)
        else:
            commit, files = self.files_of(words[3])
        if "/".join(words[2:4] if words[0] == "api" else words[:2]) != REPO or files is None:
            return self.reply({"error": "not found"}, 404, [("X-Error-Code", "RevisionNotFound")])
        if "tree" in words:
            return self.reply([{"type": "file", "path": n, "size": len(c), "oid": "0" * 40} for n, c in files.items()])
        if words[0] == "api":
            return self.reply({"id": REPO, "sha": commit, "siblings": [{"rfilename": name} for name in files]})
        content = files[words[4]]
        etag = f'"{hashlib.sha1(content).hexdigest()}"'
        self.reply(content, headers=[("ETag", etag), ("X-Repo-Commit", commit)])

    do_HEAD = do_GET

    def do_POST(self):
        body, server = self.rfile.read(int(self.headers["Content-Length"])), self.server
        if self.path == "/api/repos/create":
            server.created.append(json.loads(body))
            return self.reply({"url": REPO})
        if "/preupload/" in self.path:
            files = json.loads(body)["files"]
            return self.reply({"files": [{**file, "uploadMode": "regular", "shouldIgnore": False} for file in files]})
        if "/commit/" not in self.path:  # the check of the card's header
            return self.reply({"errors": [], "warnings": []})
        values = [json.loads(line)["value"] for line in body.splitlines() if json.loads(line)["key"] == "file"]
        commit = server.commit({value["path"]: base64.b64decode(value["content"]) for value in values})
        self.reply(
            {"success": True, "commitOid": commit, "commitUrl": f"https://huggingface.co/{REPO}/commit/{commit}"}
        )


@pytest.fixture
def server(monkeypatch, tmp_path):
    with Hub() as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        api = huggingface_hub.HfApi(endpoint=server.address, token="hf_local")
        monkeypatch.setattr(huggingface_hub, "create_repo", api.create_repo)
        monkeypatch.setattr(huggingface_hub, "upload_folder", api.upload_folder)
        cached = partial(api.snapshot_download, cache_dir=tmp_path / "cache")
        monkeypatch.setattr(huggingface_hub, "snapshot_download", cached)
        hub.download.cache_clear()
        yield server
        server.shutdown()
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
    files = server.commits[server.head]
    assert address == f"hf://{REPO}@{server.head}?sha256={hashlib.sha256(files['policy.safetensors']).hexdigest()}"
    assert set(files) == {"README.md", "SHA256SUMS", "policy.json", "policy.safetensors"}
    asked = server.created[0]
    assert asked["name"] == "runner" and (asked.get("private") or asked["visibility"] == "private")
    card = files["README.md"].decode()
    for text in (
        "library_name: torchmpm",
        f'cfp.load("hf://{REPO}")',
        "| task | `kick` |",
        "| stage 1 | 5 | 8,376.2 |",
    ):
        assert text in card, text
    loaded = cfp.load(f"hf://{REPO}")
    assert same(loaded, policy) and loaded.description == policy.description
    assert address in capsys.readouterr().err
    assert cfp.load(f"hf://{REPO}") and capsys.readouterr().err == ""  # not downloaded twice


def test_address_of_a_commit_stays_what_it_was(server, policy):
    first, other = policy.push(REPO), cfp.load("run")
    second = other.push(REPO)
    assert (
        same(cfp.load(first), policy) and same(cfp.load(second), other) and same(cfp.load(f"hf://{REPO}@main"), other)
    )


def test_changed_files_are_refused_and_others_are_not_even_downloaded(server, policy, tmp_path):
    address = policy.push(REPO)
    policies = server.commits[server.head]["policy.safetensors"], hub_bytes("run")
    assert policies[0] != policies[1]
    server.commit({"policy.safetensors": policies[1], "pytorch_model.bin": b"pickle"})
    with pytest.raises(cfp.CheckpointError, match=r"policy\.safetensors must have the SHA-256"):
        cfp.load(f"hf://{REPO}")
    assert not list(tmp_path.rglob("pytorch_model.bin"))
    digest = hashlib.sha256(policies[1]).hexdigest()
    server.commit({"SHA256SUMS": f"{digest}  policy.safetensors\n".encode()})  # whoever can do this fools no fixed hash
    with pytest.raises(cfp.CheckpointError, match=f"must have the SHA-256 .* got {digest}"):
        cfp.load(f"hf://{REPO}@main?sha256={address[-64:]}")
    server.commit({"SHA256SUMS": b""})
    with pytest.raises(cfp.CheckpointError, match="SHA256SUMS or the hash"):
        cfp.load(f"hf://{REPO}@{server.head}")
    assert cfp.load(f"hf://{REPO}@{server.head}?sha256={digest}").description["task"] == "run"


def hub_bytes(name):
    return policy_file(name).read_bytes()


def test_policies_of_other_algorithms_and_programs_take_addresses(server, policy):
    wave = baselines.OpenLoop(torch.rand(5, 2, 8, 8), policy.description | {"kind": "mpc"})
    wave.push(REPO)
    assert "baselines.load(" in server.commits[server.head]["README.md"].decode()
    assert torch.equal(baselines.load(f"hf://{REPO}").actions, wave.actions)
    address = policy.push(REPO)
    config, policies = Selection(policy=address).open(PROGRAM)
    assert config.task == "kick" and same(policies["policy"], policy)


def test_run_pushes_its_results(server, finished):
    address = cfp.Run(finished).push(REPO)
    assert "| stage 2 | 2 |" in server.commits[server.head]["README.md"].decode()
    assert same(cfp.load(address), cfp.load(finished))


@pytest.mark.parametrize(
    "address", ["hf://runner", "hf://a/b/c", "hf://a/b@", "hf://a/b?sha256=12", "hf://a/b@../../x y"]
)
def test_other_forms_of_addresses_are_refused(address):
    with pytest.raises(cfp.CheckpointError, match="path must have the form hf://OWNER/NAME"):
        cfp.load(address)


def test_what_the_hub_refuses_is_one_error(server, policy, monkeypatch):
    class TransportError(Exception):
        """What the library that carries the requests raises: neither `OSError` nor `ValueError`."""

    def unreachable(*arguments, **options):
        raise TransportError("no route to host")

    with pytest.raises(cfp.CheckpointError, match="hf://someone/else: cannot be downloaded"):
        cfp.load("hf://someone/else")
    with pytest.raises(cfp.ConfigError, match="cannot push to 'no name'"):
        policy.push("no name")
    monkeypatch.setattr(huggingface_hub, "create_repo", unreachable)
    with pytest.raises(cfp.ConfigError, match="cannot push to 'someone/runner' \\(no route to host\\)"):
        policy.push(REPO)
    with pytest.raises(cfp.ConfigError, match="policy must come from a run"):
        ActorPolicy(ActorSpec((8,))).push(REPO)


def test_missing_package_is_named(policy, monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    for use in (lambda: policy.push(REPO), lambda: cfp.load(f"hf://{REPO}@missing")):
        with pytest.raises(cfp.ConfigError, match=r"pip install 'torchmpm\[hub\]'"):
            use()

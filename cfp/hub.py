"""Policies on the Hugging Face Hub: ``hf://OWNER/NAME``, with safetensors, hashes and model cards."""

from __future__ import annotations

import functools
import hashlib
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cfp.errors import CheckpointError, ConfigError
from cfp.files import write_text

SCHEME = "hf://"
FORM = f"{SCHEME}OWNER/NAME[@REVISION][?sha256=HASH]"
_ADDRESS = re.compile(rf"{SCHEME}([\w.-]+/[\w.-]+)(?:@([\w./-]+))?(?:\?sha256=([0-9a-f]{{64}}))?")
#: Files of a repository, beside ``policy.json``; the hashes are as ``sha256sum`` writes them.
POLICY, SUMS, CARD = "policy.safetensors", "SHA256SUMS", "README.md"


def is_address(path: object) -> bool:
    """Whether a path is the address of a policy on the hub."""
    return isinstance(path, str) and path.startswith(SCHEME)


@functools.cache  # a branch that moves means the same policy throughout a program
def download(address: str) -> Path:
    """Download a policy into the cache of huggingface_hub, check its hash, and print its revision and hash.

    Args:
        address: ``hf://OWNER/NAME``, with ``@REVISION`` (a branch, a tag or a commit) and ``?sha256=HASH`` if wanted.

    Returns:
        The file ``policy.safetensors``.

    Raises:
        CheckpointError: The address has another form, nothing can be downloaded, or the file has another hash than
            the address, or else ``SHA256SUMS`` in the repository, says.
        ConfigError: huggingface_hub is not installed.
    """
    found = _ADDRESS.fullmatch(address)
    if found is None:
        raise CheckpointError(f"path must have the form {FORM}, got {address!r}")
    repo, revision, expected = found.groups()
    hub = _library()
    try:
        folder = Path(hub.snapshot_download(repo, revision=revision, allow_patterns=[POLICY, SUMS]))
        digest = hashlib.sha256((folder / POLICY).read_bytes()).hexdigest()
        expected = expected or dict(line.split()[::-1] for line in (folder / SUMS).read_text().splitlines())[POLICY]
    except (OSError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())
        raise CheckpointError(
            f"{address}: cannot be downloaded with {SUMS} or the hash in the address ({reason})"
        ) from error
    if digest != expected:
        raise CheckpointError(f"{address}: {POLICY} must have the SHA-256 {expected}, got {digest}")
    print(f"{address}: {pinned(repo, folder.name, digest)}", file=sys.stderr)
    return folder / POLICY


def pinned(repo: str, commit: str, digest: str) -> str:
    """Address of one commit of a repository, with the hash of its policy."""
    return f"{SCHEME}{repo}@{commit}?sha256={digest}"


class Shareable:
    """A policy that can be saved, and pushed to the hub."""

    description: dict[str, Any]

    def save(self, path: Path) -> None:
        """Write ``path`` (``.safetensors``) and the ``.json`` beside it."""
        raise NotImplementedError

    def push(self, repo: str, *, results: Sequence[Mapping[str, Any]] = (), private: bool = False) -> str:
        """Upload the policy to the Hugging Face Hub with a model card, as one commit.

        Needs the extra ``hub`` and a token, see ``hf auth login``.

        Args:
            repo: ``"OWNER/NAME"``; the repository is created if need be.
            results: Returns for the card, such as `cfp.Run.results`.
            private: Create the repository as a private one.

        Returns:
            The address of this commit for `cfp.load`, with the hash of the policy.

        Raises:
            ConfigError: The policy comes from no run, so that its task is not known, or the hub refuses it.
        """
        if "kind" not in self.description:
            raise ConfigError(f"policy must come from a run, got one with the description {self.description}")
        hub = _library()
        with TemporaryDirectory() as name:
            folder = Path(name)
            self.save(folder / POLICY)
            digest = hashlib.sha256((folder / POLICY).read_bytes()).hexdigest()
            write_text(folder / SUMS, f"{digest}  {POLICY}\n")
            write_text(folder / CARD, card(repo, self.description, results))
            try:
                hub.create_repo(repo, private=private, exist_ok=True)
                commit = hub.upload_folder(
                    repo_id=repo, folder_path=folder, commit_message=f"Policy for {self.description['task']}"
                )
            except Exception as error:  # without a network, errors of the library that carries its requests
                raise ConfigError(f"repo: cannot push to {repo!r} ({' '.join(str(error).split())})") from error
        return pinned(repo, commit.oid, digest)


def card(repo: str, description: Mapping[str, Any], results: Sequence[Mapping[str, Any]] = ()) -> str:
    """The model card of a policy: what it is, how to use it, how it was trained, and its ``results``."""
    package = "cfp" if description["kind"] == "cfp" else "baselines"
    network = {name: value for name, value in description.items() if name not in ("format", "version", "environment")}
    training = "\n".join(f"| {name} | `{value}` |" for name, value in (network | description["environment"]).items())
    header = "---\nlibrary_name: torchmpm\npipeline_tag: reinforcement-learning\n"
    text = f"""{header}tags: [reinforcement-learning, soft-robotics, torchmpm]
---

# {description["kind"]} on {description["task"]}

A policy of the algorithm `{description["kind"]}` for the task `{description["task"]}` of torchmpm, after
{description["steps"]:,} environment steps.

```python
import {package}

policy = {package}.load("{SCHEME}{repo}")
```

## Training

| option | value |
| --- | --- |
{training}
"""
    if results:
        rows = "\n".join(
            f"| {row['policy'].strip()} | {row['episodes']} | {row['mean']:,.1f} | {row['std']:,.1f} |"
            for row in results
        )
        text += (
            f"\n## Returns\n\n| policy | episodes | mean | standard deviation |\n| --- | --- | --- | --- |\n{rows}\n"
        )
    return text


def _library() -> Any:
    """The package huggingface_hub, which is an extra."""
    try:
        import huggingface_hub
    except ModuleNotFoundError as error:
        raise ConfigError("policies on the hub need huggingface_hub: pip install 'torchmpm[hub]'") from error
    return huggingface_hub

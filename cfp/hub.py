"""Policies on the Hugging Face Hub, ``hf://OWNER/NAME``, with model cards."""

from __future__ import annotations

import functools
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cfp.errors import CheckpointError, ConfigError
from cfp.files import write_text

SCHEME = "hf://"
_ADDRESS = re.compile(rf"{SCHEME}([\w.-]+/[\w.-]+)(?:@([\w./-]+))?")
FILE = "policy.safetensors"


def is_address(path: object) -> bool:
    """Whether a path is the address of a policy on the hub."""
    return isinstance(path, str) and path.startswith(SCHEME)


@functools.cache  # a branch that moves means the same policy throughout a program
def download(address: str) -> Path:
    """Download a policy into the cache of huggingface_hub, and print the address of its commit.

    Args:
        address: ``hf://OWNER/NAME``, with ``@REVISION`` (a branch, a tag or a commit) if wanted.

    Returns:
        The file ``policy.safetensors``.

    Raises:
        CheckpointError: The address has another form, or nothing can be downloaded.
        ConfigError: huggingface_hub is not installed.
    """
    found = _ADDRESS.fullmatch(address)
    if found is None:
        raise CheckpointError(f"path must have the form {SCHEME}OWNER/NAME[@REVISION], got {address!r}")
    repo, revision = found.groups()
    hub = _library()
    try:
        file = Path(hub.hf_hub_download(repo, FILE, revision=revision))
    except Exception as error:  # without a network, also those of the library that carries the requests
        raise CheckpointError(f"{address}: cannot be downloaded ({' '.join(str(error).split())})") from error
    print(f"{address}: {SCHEME}{repo}@{file.parent.name}", file=sys.stderr)
    return file


class Shareable:
    """A policy that can be saved, and pushed to the Hugging Face Hub."""

    description: dict[str, Any]

    @property
    def resolution(self) -> int:
        """Rows and columns of its actions."""
        raise NotImplementedError

    def __repr__(self) -> str:
        """What it is for and comes from, as far as that is known; the weights would fill pages."""
        about = {**self.description, "resolution": self.resolution}
        shown = [f"{name}={about[name]!r}" for name in ("task", "resolution", "steps", "seed") if name in about]
        return f"{type(self).__name__}({', '.join(shown)})"

    def save(self, path: Path) -> None:
        """Write ``path`` (``.safetensors``) and the ``.json`` beside it."""
        raise NotImplementedError

    def push(self, repo: str, *, results: Sequence[Mapping[str, Any]] = (), private: bool = False) -> str:
        """Upload the policy to the Hugging Face Hub with a model card, as one commit.

        Needs the extra ``hub`` and a token, see ``hf auth login``.

        Args:
            repo: Name of the repository, ``"OWNER/NAME"``; it is created if it does not exist.
            results: Rows of results for the card, such as `cfp.Run.results`.
            private: Whether a new repository is private; one that exists stays as visible as it is.

        Returns:
            The address of this commit, for `cfp.load` or `baselines.load`.

        Raises:
            cfp.ConfigError: The policy comes from no run, so that its task is not known; huggingface_hub is not
                installed; or the Hub refuses the upload.
        """
        if "kind" not in self.description:
            raise ConfigError(f"policy must come from a run, got one with the description {self.description}")
        hub = _library()
        with TemporaryDirectory() as folder:
            self.save(Path(folder) / FILE)
            write_text(Path(folder) / "README.md", _card(repo, self.description, results))
            try:
                hub.create_repo(repo, private=private, exist_ok=True)
                commit = hub.upload_folder(
                    repo_id=repo, folder_path=folder, commit_message=f"Policy for {self.description['task']}"
                )
            except Exception as error:
                raise ConfigError(f"repo: cannot push to {repo!r} ({' '.join(str(error).split())})") from error
        return f"{SCHEME}{repo}@{commit.oid}"


def _card(repo: str, description: Mapping[str, Any], results: Sequence[Mapping[str, Any]]) -> str:
    """The model card of a policy: what it is, how to use it, and its ``results``; ``policy.json`` has the options."""
    kind, task = description["kind"], description["task"]
    package = "cfp" if kind == "cfp" else "baselines"
    rows = [
        f"| {row['policy'].strip()} | {row['episodes']} | {row['mean']:,.1f} | {row['std']:,.1f} |" for row in results
    ]
    table = ["", "| policy | episodes | mean return | standard deviation |", "| --- | --- | --- | --- |", *rows, ""]
    return f"""---
library_name: torchmpm
pipeline_tag: reinforcement-learning
tags: [reinforcement-learning, soft-robotics, torchmpm]
---

# {kind} on {task}

A policy of the algorithm `{kind}` for the task `{task}` of torchmpm, after {description["steps"]:,} environment steps
with seed {description["seed"]}. The file `policy.json` holds the options of its training.

```python
import {package}

policy = {package}.load("{SCHEME}{repo}")
```
""" + ("\n".join(table) if rows else "")


def _library() -> Any:
    """The package huggingface_hub, which is an extra."""
    try:
        import huggingface_hub
    except ModuleNotFoundError as error:
        raise ConfigError("policies on the hub need huggingface_hub: pip install 'torchmpm[hub]'") from error
    return huggingface_hub

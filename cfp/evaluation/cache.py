"""Episodes of untrained policies, kept on disk: they are the same for every policy that is compared with them."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import logging
import os
import platform
from pathlib import Path
from typing import Any

import numpy as np
import torch

import dittogym
import torchmpm
from cfp.config import RunConfig
from cfp.envs.make import choose_device
from cfp.files import read_json, write_json
from dittogym.tasks import fingerprint
from torchmpm.native.cpu.library import cache_folder, processor, provenance

#: Environment variable that names the folder; empty: nothing is kept.
VARIABLE = "TORCHMPM_EPISODES"
_logger = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Episode:
    """How an episode went."""

    total: float  # its undiscounted return
    success: bool | None  # None where the task does not define success


@dataclasses.dataclass(frozen=True)
class EpisodeCache:
    """The kept episodes of one policy under the same conditions, a file for each layout."""

    folder: Path
    key: str

    @classmethod
    def of(cls, config: RunConfig, policy: str, resolution: int) -> EpisodeCache | None:
        """Cache for an untrained policy; None where none is wanted, or the task is not of the library."""
        folder = os.environ.get(VARIABLE, os.path.join(cache_folder(), "episodes"))
        if not folder or fingerprint(config.task) is not None:  # what the file of a custom task imports may change
            return None
        return cls(Path(folder), json.dumps(_conditions(config) | {"policy": policy, "resolution": resolution}))

    def _file(self, layout: int) -> Path:
        return self.folder / f"{hashlib.sha256(f'{self.key} {layout}'.encode()).hexdigest()[:32]}.json"

    def read(self, layout: int) -> Episode | None:
        """A kept episode; None if there is none, or its file is damaged."""
        try:
            values = read_json(self._file(layout))
            return Episode(float(values["total"]), values["success"])
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def write(self, layout: int, episode: Episode) -> None:
        """Keep an episode, if the folder can be written."""
        try:
            write_json(self._file(layout), dataclasses.asdict(episode), shared=True)
        except OSError as error:
            _logger.info("episodes cannot be kept in %s (%s)", self.folder, error)


def _conditions(config: RunConfig) -> dict[str, Any]:
    """All that an episode of a policy that does not learn depends on, beside its layout."""
    environment = dataclasses.asdict(config.environment)
    del environment["num_envs"]
    target = config.make_spec().target  # may be drawn, or read from a file
    return {
        "task": config.task,
        "environment": environment,
        "target": None if target is None else hashlib.sha256(np.asarray(target).tobytes()).hexdigest(),
        "device": choose_device(config.device),
        "sources": _sources(),
        "machine": [platform.python_version(), np.__version__, torch.__version__, str(provenance()), processor()],
    }


@functools.cache
def _sources() -> str:
    """Hash of the version and the source files of all that an episode goes through."""
    digest = hashlib.sha256(torchmpm.__version__.encode())
    packages = (Path(str(module.__file__)).parent for module in (torchmpm, dittogym))
    for folder in (*packages, Path(__file__).parents[1]):
        for file in sorted(path for path in folder.rglob("*") if path.suffix in (".py", ".cpp", ".hpp")):
            digest.update(f"{file.relative_to(folder)} ".encode() + file.read_bytes())
    return digest.hexdigest()

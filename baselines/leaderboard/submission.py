"""A submission: one policy on one task under one protocol, as a JSON file that can be checked."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from baselines.common.reference_policies import REFERENCE_POLICIES
from baselines.leaderboard.protocol import PROTOCOLS
from cfp.errors import ConfigError
from cfp.evaluation.returns import Result, numbers
from cfp.experiment.algorithm import Sees
from cfp.files import read_json
from cfp.from_dict import update_from_dict

#: Of recomputed scores, which are rounded to three decimals.
TOLERANCE = 0.0015
NAME = re.compile(r"[\w .,+()-]{1,60}", re.ASCII)
VERSION, HASH = re.compile(r"\d+(\.\d+)+[\w.+-]*", re.ASCII), re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Training:
    """What the training took, teachers included, as the submitter states it; None if that is not known."""

    steps: int | None = None  # environment steps
    minutes: float | None = None  # wall time


@dataclass(frozen=True)
class Scores:
    """What follows from the episodes."""

    mean: float = math.nan  # return
    interval: float = math.nan  # half the width of its 95 % confidence interval, Student's t over the layouts
    success: float = math.nan  # share of successful episodes

    @classmethod
    def of(cls, returns: Sequence[float], successes: Sequence[bool]) -> "Scores":
        """The scores of some episodes."""
        row = numbers(Result("", 1, tuple(returns), sum(successes) / len(successes)))
        return cls(row["mean"], row["interval"], row["success"])


@dataclass(frozen=True)
class Submission:
    """The entries of the file."""

    protocol: str = ""
    task: str = ""
    policy: str = ""  # the name that is shown
    sha256: str | None = None  # of the policy file; None for reference policies
    sees: Sees = "nothing"
    training: Training = Training()
    library: str = ""  # version that played the episodes
    returns: tuple[float, ...] = ()  # undiscounted, one per layout
    successes: tuple[bool, ...] = ()  # as many
    scores: Scores = Scores()

    @property
    def key(self) -> tuple[str, str, str]:
        """What only one submission may have: protocol, task, and hash or name of the policy."""
        return self.protocol, self.task, self.sha256 or self.policy

    def defects(self) -> list[str]:
        """What is wrong in it, a line each."""
        if self.protocol not in PROTOCOLS:
            return [f"protocol must be {' or '.join(PROTOCOLS)}, got {self.protocol!r}"]
        protocol, reference = PROTOCOLS[self.protocol], self.policy in REFERENCE_POLICIES
        count, found = len(protocol.seeds), []
        if self.task not in protocol.tasks:
            found.append(f"task must be one of {', '.join(protocol.tasks)}, got {self.task!r}")
        if not NAME.fullmatch(self.policy):
            found.append(f"policy must be 1 to 60 letters, digits, spaces or any of _.,+()-, got {self.policy!r}")
        if reference and (self.sha256, self.sees) != (None, "nothing"):
            found.append(
                f"sha256 and sees must be null and 'nothing' for {self.policy}, got {self.sha256!r}, {self.sees!r}"
            )
        if not reference and not HASH.fullmatch(self.sha256 or ""):
            found.append(f"sha256 must be 64 hexadecimal digits for a trained policy, got {self.sha256!r}")
        if not VERSION.fullmatch(self.library):
            found.append(f"library must be a version such as '0.1.0', got {self.library!r}")
        for name, value in asdict(self.training).items():
            if value is not None and not 0 <= value < math.inf:
                found.append(f"training.{name} must be null or at least 0, got {value}")
        for name, given in (("returns", self.returns), ("successes", self.successes)):
            if len(given) != count:
                found.append(f"{name} must have {count} values, one per layout, got {len(given)}")
        if not all(map(math.isfinite, self.returns)):
            found.append(f"returns must be finite, got {list(self.returns)}")
        return found or self._wrong_scores()

    def _wrong_scores(self) -> list[str]:
        expected, given = asdict(Scores.of(self.returns, self.successes)), asdict(self.scores)
        return [
            f"scores.{name} must be {value:.3f}, as the episodes give, got {given[name]}"
            for name, value in expected.items()
            if not abs(given[name] - value) <= TOLERANCE  # NaN is wrong, too
        ]


def read_submission(path: Path) -> Submission:
    """Read a file and check it; a `ConfigError` with a line for each defect if it is no valid submission."""
    try:
        values = read_json(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read as JSON ({error})") from error
    submission, names = Submission(), [entry.name for entry in fields(Submission)]
    found = [f"{name} is missing" for name in names if name not in values]
    found += [f"{name!r} is not an entry; entries are {', '.join(names)}" for name in values if name not in names]
    for name in filter(values.__contains__, names):
        try:
            submission = update_from_dict(submission, {name: values[name]})
        except ConfigError as error:
            found.append(str(error))
    if found := found or submission.defects():
        raise ConfigError("\n".join(f"{path}: {each}" for each in found))
    return submission


def read_submissions(paths: Iterable[Path]) -> list[Submission]:
    """Read files, no two of the same policy; a `ConfigError` with a line for each defect of any."""
    found: dict[tuple[str, str, str], Path] = {}
    submissions, defects = [], []
    for path in paths:
        try:
            submissions.append(read_submission(path))
        except ConfigError as error:
            defects.append(str(error))
            continue
        if (first := found.setdefault(submissions[-1].key, path)) is not path:
            defects.append(f"{path}: a policy must have one submission for a task, this one has {first}, too")
    if defects:
        raise ConfigError("\n".join(defects))
    return submissions

"""The eight tasks of DittoGym, as Gymnasium environments and as batched, differentiable torch environments.

Importing this package registers the Gymnasium ids ``dittogym/{task}-{coarse|fine}-v0``; :func:`register` adds a custom
task.
"""

from dittogym.conditions import Conditions
from dittogym.env import Env
from dittogym.registration import register
from dittogym.rewards import Reward, Transition
from dittogym.spec import TaskSpec
from dittogym.tasks import TASKS, make_spec
from dittogym.torch_env import TorchEnv
from dittogym.vector import BatchEnv

for _task, _make in list(TASKS.items()):
    register(_task, _make)

__all__ = [
    "TASKS",
    "BatchEnv",
    "Conditions",
    "Env",
    "Reward",
    "TaskSpec",
    "TorchEnv",
    "Transition",
    "make_spec",
    "register",
]

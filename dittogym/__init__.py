"""DittoGym's tasks: robots of soft, plastic matter that change their shape while they work.

Importing this package registers the Gymnasium ids ``dittogym/{task}-{coarse|fine}-v0``; :func:`register` adds a custom
task.
"""

from dittogym.contract import Outcome
from dittogym.env import Env
from dittogym.registration import register, register_all
from dittogym.spec import TaskSpec
from dittogym.tasks import TASKS, make_spec
from dittogym.torch_env import TorchEnv
from dittogym.vector import BatchEnv

register_all()

__all__ = ["TASKS", "BatchEnv", "Env", "Outcome", "TaskSpec", "TorchEnv", "make_spec", "register"]

"""Algorithms to compare the coarse-to-fine policy with, behind the same command lines, folders and policies."""

from baselines.actor_critic import StatePolicy
from baselines.algorithm import Algorithm, Entry
from baselines.cem import CEM, CEMConfig, CEMPlanner, CEMPlannerConfig
from baselines.distillation import Distill, DistillConfig
from baselines.gradient import Gradient, GradientConfig
from baselines.modular import ModularConfig
from baselines.modular_policy import SegmentPolicy
from baselines.mpc import MPC, MPCConfig
from baselines.open_loop import OpenLoop
from baselines.planner import Planner, PlannerConfig
from baselines.registry import ALGORITHMS, load
from baselines.shac import Shac, ShacConfig

__all__ = [
    "ALGORITHMS",
    "CEM",
    "MPC",
    "Algorithm",
    "CEMConfig",
    "CEMPlanner",
    "CEMPlannerConfig",
    "Distill",
    "DistillConfig",
    "Entry",
    "Gradient",
    "GradientConfig",
    "MPCConfig",
    "ModularConfig",
    "OpenLoop",
    "Planner",
    "PlannerConfig",
    "SegmentPolicy",
    "Shac",
    "ShacConfig",
    "StatePolicy",
    "load",
]

"""Distillation of planners and privileged policies into image policies (DAgger)."""

"""Where particles start: shapes, drawings and initial positions."""

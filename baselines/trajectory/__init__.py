"""Open-loop optimisation of a whole sequence of actions by gradients."""

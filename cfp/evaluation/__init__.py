"""Evaluation of policies, and what is shown of them: tables, plots, videos and the run page."""

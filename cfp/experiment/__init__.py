"""One training run: command line, run folder, callbacks, checkpoints and loggers."""

"""The run: setup, learner, loop, ledger of conversions, checkpoints, evaluation."""

"""Terms of the decision process: rewards, terminations, actions, resets."""

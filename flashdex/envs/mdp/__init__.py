"""Rewards, terminations, actions, resets and the assist; how terms are registered."""

from flashdex.envs.mdp.term import allow, number, observation, reward, termination

__all__ = ["allow", "number", "observation", "reward", "termination"]

"""What a checkpoint holds of the training loop."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from flashdex.modules.layers import restore_generator
from flashdex.recipe import dump_recipe

if TYPE_CHECKING:
    from flashdex.training.loop import Trainer


def loop_state(trainer: Trainer) -> dict[str, Any]:
    """Everything a resumed run needs, tensors and plain values only.

    The samplers hold nothing but what the conversions say, and those are in files.

    Args:
        trainer: between two vector steps, its attempts all judged.
    """
    assist = trainer.env.assist
    return {
        "env_steps": trainer.env_steps,
        "vector_steps": trainer.vector_steps,
        "wall_s": trainer.wall_s,
        "env_steps_lost": trainer.start.lost,
        "learner": trainer.learner.state_dict(),
        "assist": None if assist is None else assist.state_dict(),
        "assist_epoch": trainer.assist_epoch.state_dict(),
        "env_generator": trainer.env.generator.get_state(),
        "torch_rng": torch.get_rng_state(),
        "ledger_bytes": trainer.ledger.num_bytes,
        "recipe": dump_recipe(trainer.recipe),
        "wandb_id": trainer.log.wandb_id,
    }


def load_loop_state(trainer: Trainer, state: dict[str, Any]) -> None:
    """Restore all of ``loop_state`` but the learner, which is restored already.

    Args:
        trainer: of a new session.
        state: from ``loop_state``.
    """
    trainer.vector_steps = state["vector_steps"]
    trainer.assist_epoch.load_state_dict(state["assist_epoch"])
    if trainer.env.assist is not None and state["assist"] is not None:
        trainer.env.assist.load_state_dict(state["assist"])
        trainer.env.redraw_assist()
    restore_generator(trainer.env.generator, state["env_generator"])
    torch.set_rng_state(state["torch_rng"])

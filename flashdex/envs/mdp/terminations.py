"""Terminations: failures, and which hand is to blame for them.

Each gives a mask (N, 2): the hand whose object or fingertips ended the episode. A hand
that takes no part in the motion is never blamed.
"""

from __future__ import annotations

import torch
from torch import Tensor

from flashdex import keys
from flashdex.envs.mdp.step import Step, TermContext
from flashdex.envs.mdp.term import number, termination


@termination(inputs=lambda step: (step.own_pos, step.ref["own_pos"]), needs_object=True)
def object_dropped(
    pos: Tensor, ref_pos: Tensor, *, distance: float = number(0.1, above=0, high=1e6)
) -> Tensor:
    """Object below its reference height; charges the hand of that object.

    Args:
        pos: object, world, m, (N, 2, 3).
        ref_pos: its reference, (N, 2, 3).
        distance: Allowed drop, m.
    """
    return pos[..., 2] < ref_pos[..., 2] - distance


def early_reset_line(steps: Tensor, *, threshold: float, window: int) -> Tensor:
    """Least sum of object rewards after n steps: ``0.6 * 5 * floor((n - 1) / 5)``."""
    blocks = torch.div(steps - 1, window, rounding_mode="floor").clamp_min(0)
    return threshold * window * blocks.float()


def early_reset(
    # sum of the raw object term (0..1 a step) since the reset, (N, 2)
    object_sum: Tensor,
    steps: Tensor,  # control steps since the reset, (N,)
    active: Tensor,  # hands that take part, (N, 2) bool
    *,
    threshold: float,  # mean reward demanded, 0.6
    window: int,  # steps of one block, 5
) -> Tensor:
    """Running object reward below the line; blames the hands below it themselves."""
    line = early_reset_line(steps, threshold=threshold, window=window)
    weight = active.float()
    mean = (object_sum * weight).sum(-1) / weight.sum(-1).clamp_min(1.0)
    fires = (mean < line).unsqueeze(-1)
    return fires & (object_sum < line.unsqueeze(-1)) & active


@termination("early_reset", needs_object=True, sums="task")
class EarlyReset:
    """Running sum of the object term below a line; charges hands below it.

    Args:
        context: number of worlds and device.
        threshold: Demanded mean of the object term; 0.6 is a point error of 5.1 cm.
        window: Steps between raises of the line; also the grace, control steps.
    """

    def __init__(
        self,
        context: TermContext,
        *,
        threshold: float = number(0.6, low=0, high=1),
        window: int = number(5, low=1, high=10**6),
    ) -> None:
        self.threshold, self.window = threshold, window
        device = context.bank.table.device
        self.object_sum = torch.zeros(context.num_envs, 2, device=device)

    def reset(self, mask: Tensor) -> None:
        """Forget the sums of worlds that start anew, (N,) bool."""
        self.object_sum = torch.where(mask.unsqueeze(-1), 0.0, self.object_sum)

    def __call__(self, step: Step) -> Tensor:
        """See the class, (N, 2) bool."""
        if step.task is not None:
            self.object_sum = self.object_sum + step.task
        return early_reset(
            self.object_sum,
            step.steps,
            step.present,
            threshold=self.threshold,
            window=self.window,
        )


@termination(inputs=lambda step: (step.kin["tip_pos"], step.ref["tip_pos"], step.steps))
def fingertip_off(
    pos: Tensor,
    ref_pos: Tensor,
    steps: Tensor,
    *,
    distance: float = number(0.2, above=0, high=1e6),
    grace: int = number(15, low=0, high=10**6),
) -> Tensor:
    """A fingertip far from its human tip; charges that hand.

    Args:
        pos: robot fingertips, world, m, (N, 2, 5, 3).
        ref_pos: human fingertips, (N, 2, 5, 3).
        steps: control steps since the reset, (N,).
        distance: Allowed distance, m.
        grace: Steps after a reset that are not judged, control steps.
    """
    off = ((pos - ref_pos).norm(dim=-1) > distance).any(-1)
    return off & (steps > grace).unsqueeze(-1)


def _speeds(step: Step) -> tuple[Tensor, ...]:
    state = step.state
    velocities = state[keys.JOINT_VEL], step.kin["link_linvel"], state[keys.OBJECT_VEL]
    return *velocities, state["bad"]


@termination(inputs=_speeds, in_evaluation=True)
def sanity(
    joint_vel: Tensor,
    link_linvel: Tensor,
    object_vel: Tensor,
    numerics: Tensor,
    *,
    max_link_speed: float = number(100.0, above=0, high=1e6),
    max_joint_speed: float = number(200.0, above=0, high=1e6),
    max_object_speed: float = number(100.0, above=0, high=1e6),
    max_object_spin: float = number(200.0, above=0, high=1e6),
) -> Tensor:
    """Speeds no healthy simulation reaches, or NaN; charges both hands.

    Args:
        joint_vel: (N, 2, J) rad/s.
        link_linvel: (N, 2, L, 3) m/s.
        object_vel: (N, O, 6) m/s and rad/s.
        numerics: engine reported a bad state, (N,) bool.
        max_link_speed: Hand links, m/s.
        max_joint_speed: Hand joints, m/s and rad/s.
        max_object_speed: Objects, m/s.
        max_object_spin: Objects, rad/s.
    """
    bad = numerics.clone()
    bad |= ~torch.isfinite(joint_vel).flatten(1).all(1)
    bad |= ~torch.isfinite(object_vel).flatten(1).all(1)
    bad |= (joint_vel.abs() > max_joint_speed).flatten(1).any(1)
    bad |= (link_linvel.norm(dim=-1) > max_link_speed).flatten(1).any(1)
    bad |= (object_vel[..., :3].norm(dim=-1) > max_object_speed).any(1)
    bad |= (object_vel[..., 3:].norm(dim=-1) > max_object_spin).any(1)
    return bad.unsqueeze(-1).expand(-1, 2)

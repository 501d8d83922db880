"""Categorical critics of all groups, one fused ensemble of layout [group, member]."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from flashdex.modules.future import FutureEncoder
from flashdex.modules.layers import Mode, UnitLinear, held
from flashdex.modules.trunk import FlashTrunk

CriticAction = Literal["joint", "own"]


class EnsembleCritic(nn.Module):
    """G groups times M members: distributions of the return on fixed atoms.

    ``z = linspace(-v_max, v_max, num_atoms)``, ``Q = sum_z p(z | s, a) z``. Minimum and
    argmin run over the member axis only, never across groups.

    Args:
        observation_dim: width of the observation.
        action_dim: actions A of one group.
        num_groups: number of groups G; the critics read all G actions, (B, G A).
        num_members: critics M per group (twin: 2).
        width: residual stream.
        num_blocks: residual blocks.
        num_atoms: atoms Z.
        v_max: end of the support; equals the bound of the reward normaliser.
        critic_action: ``joint`` reads the actions of all groups, ``own`` only those of
            its group.
        future_encoder: encoder with ``ensemble=1`` shared by all members, or None.

    Example:
        >>> critic = EnsembleCritic(9, 4, num_groups=2, width=16)
        >>> critic(torch.randn(3, 9), torch.randn(3, 8), mode="eval").shape
        torch.Size([2, 2, 3, 101])
    """

    atoms: Tensor

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        num_groups: int = 1,
        num_members: int = 2,
        width: int = 256,
        num_blocks: int = 2,
        num_atoms: int = 101,
        v_max: float = 5.0,
        critic_action: CriticAction = "joint",
        future_encoder: FutureEncoder | None = None,
    ) -> None:
        super().__init__()
        self.num_groups, self.num_members = num_groups, num_members
        self.num_atoms, self.v_max = num_atoms, v_max
        ensemble = num_groups * num_members
        self.future_encoder = future_encoder
        latent = future_encoder.latent_dim if future_encoder is not None else 0
        mask = None
        if critic_action == "own" and num_groups > 1:
            own = torch.eye(num_groups).repeat_interleave(num_members, 0)
            own = own.repeat_interleave(action_dim, 1)
            mask = torch.cat([torch.ones(ensemble, observation_dim + latent), own], 1)
        self.trunk = FlashTrunk(
            observation_dim + latent + num_groups * action_dim,
            width,
            num_blocks=num_blocks,
            ensemble=ensemble,
            column_mask=mask,
        )
        self.head = UnitLinear(width, num_atoms, ensemble=ensemble)
        self.head_bias = nn.Parameter(torch.zeros(ensemble, num_atoms))
        self.register_buffer(
            "atoms", torch.linspace(-v_max, v_max, num_atoms), persistent=False
        )

    def forward(
        self,
        observation: Tensor,
        action: Tensor,
        future: Tensor | None = None,
        *,
        mode: Mode,
        keep: slice | None = None,
    ) -> Tensor:
        """Log-probabilities of the atoms, (G, M, B, Z).

        The observation is (B, D), the window (B, C, K), the joint action (B, G A) or
        one view of it per group, (G, B, G A). Only the rows ``keep`` are returned;
        every row enters the batch statistics.
        """
        parts = [observation]
        if self.future_encoder is not None:
            parts.append(self.future_encoder(future, mode=mode).squeeze(0))
        if action.dim() == 3:
            action = action.repeat_interleave(self.num_members, 0)
        x = self.trunk([*parts, action], mode=mode, keep=keep)
        logits = self.head(x, mode=mode) + held(self.head_bias, mode)[:, None]
        log_prob = torch.log_softmax(logits, dim=-1)
        return log_prob.unflatten(0, (self.num_groups, self.num_members))

    def expected_value(self, log_prob: Tensor) -> Tensor:
        """``Q = sum_z p z`` of log-probabilities (..., Z)."""
        return log_prob.exp() @ self.atoms

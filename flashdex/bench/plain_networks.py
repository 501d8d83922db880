"""FlashSAC networks in the plainest form: one ``nn.Module`` a network, no fusing.

What a competent reader of the paper writes first. The learner benchmark measures the
library against it, and its tests hold both to the same numbers.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn
from torch.nn import functional

NUM_ATOMS, V_MAX = 101, 5.0


class PlainBatchNorm(nn.Module):
    """BatchNorm of (B, d) whose mode is an argument of the call.

    Args:
        features: size d.
    """

    mean: Tensor
    var: Tensor

    def __init__(self, features: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(features))
        self.bias = nn.Parameter(torch.zeros(features))
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("var", torch.ones(features))

    def forward(self, x: Tensor, *, training: bool) -> Tensor:
        """Normalise ``x``; training moves the running statistics by 0.01."""
        return functional.batch_norm(
            x, self.mean, self.var, self.weight, self.bias, training, 0.01, 1e-5
        )


class PlainBlock(nn.Module):
    """``x + relu(BN(W2 relu(BN(W1 x))))``.

    Args:
        width: size of the residual stream.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear1 = nn.Linear(width, 4 * width, bias=False)
        self.norm1 = PlainBatchNorm(4 * width)
        self.linear2 = nn.Linear(4 * width, width, bias=False)
        self.norm2 = PlainBatchNorm(width)

    def forward(self, x: Tensor, *, training: bool) -> Tensor:
        """Transform ``x`` (B, width)."""
        y = functional.relu(self.norm1(self.linear1(x), training=training))
        return x + functional.relu(self.norm2(self.linear2(y), training=training))


class PlainTrunk(nn.Module):
    """BatchNorm, linear map, blocks and one RMSNorm.

    Args:
        inputs: width of the input.
        width: size of the residual stream.
        num_blocks: residual blocks.
    """

    def __init__(self, inputs: int, width: int, num_blocks: int = 2) -> None:
        super().__init__()
        self.norm_in = PlainBatchNorm(inputs)
        self.embed = nn.Linear(inputs, width, bias=False)
        self.blocks = nn.ModuleList(PlainBlock(width) for _ in range(num_blocks))
        self.rms = nn.RMSNorm(width, eps=1e-6)

    def forward(self, x: Tensor, *, training: bool) -> Tensor:
        """Features (B, width) of ``x`` (B, inputs)."""
        x = self.embed(self.norm_in(x, training=training))
        for block in self.blocks:
            x = block(x, training=training)
        return self.rms(x)


class PlainEncoder(nn.Module):
    """Three temporal convolutions with SiLU and a linear read-out.

    Args:
        channels: features of one frame.
        num_frames: frames of the window.
        latent: size of the output.
        widths: output channels of the convolutions.
    """

    def __init__(
        self, channels: int, num_frames: int, latent: int, widths: tuple[int, int, int]
    ) -> None:
        super().__init__()
        self.conv1 = nn.Conv1d(channels, widths[0], 1)
        self.conv2 = nn.Conv1d(widths[0], widths[1], 4, stride=2)
        self.conv3 = nn.Conv1d(widths[1], widths[2], 2)
        length = (num_frames - 4) // 2
        self.read_out = nn.Linear(length * widths[2], latent)

    def forward(self, future: Tensor) -> Tensor:
        """Encode (B, channels, num_frames) to (B, latent)."""
        x = functional.silu(self.conv1(future))
        x = functional.silu(self.conv2(x))
        x = functional.silu(self.conv3(x))
        return self.read_out(x.mT.flatten(1))


class PlainActor(nn.Module):
    """One policy tower with the centred head.

    Args:
        inputs: width of the observation, latent included.
        action_dim: actions A.
        width: residual stream.
        encoder: of the future window, or None.
    """

    def __init__(
        self, inputs: int, action_dim: int, width: int, encoder: PlainEncoder | None
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.trunk = PlainTrunk(inputs, width)
        self.mean_head = nn.Linear(width, action_dim)
        self.std_head = nn.Linear(width, action_dim)

    def forward(
        self, observation: Tensor, future: Tensor | None, *, training: bool
    ) -> tuple[Tensor, Tensor]:
        """Mean and std, (B, A) each."""
        x = join(observation, self.encoder, future)
        x = self.trunk(x, training=training)
        log_std = -5.0 + 2.5 * (1.0 + torch.tanh(self.std_head(x)))
        return self.mean_head(x), log_std.exp()


class PlainCritics(nn.Module):
    """Twin critics of all groups as separate networks over one shared encoder.

    Args:
        inputs: width of observation, latent and joint action together.
        width: residual stream.
        num_groups: groups G.
        encoder: of the future window, or None.
    """

    def __init__(
        self, inputs: int, width: int, num_groups: int, encoder: PlainEncoder | None
    ) -> None:
        super().__init__()
        self.encoder = encoder
        count = 2 * num_groups
        self.trunks = nn.ModuleList(PlainTrunk(inputs, width) for _ in range(count))
        self.heads = nn.ModuleList(nn.Linear(width, NUM_ATOMS) for _ in range(count))

    def observe(self, observation: Tensor, future: Tensor | None) -> Tensor:
        """Observation and latent side by side: the same for all members."""
        return join(observation, self.encoder, future)

    def member(
        self, index: int, seen: Tensor, action: Tensor, *, training: bool
    ) -> Tensor:
        """Log-probabilities (B, Z) of member ``2 group + twin``."""
        x = torch.cat([seen, action], -1)
        x = self.trunks[index](x, training=training)
        return functional.log_softmax(self.heads[index](x), -1)


def join(
    observation: Tensor, encoder: PlainEncoder | None, future: Tensor | None
) -> Tensor:
    """Observation with the latent of the window behind it."""
    if encoder is None:
        return observation
    assert future is not None
    return torch.cat([observation, encoder(future)], -1)


@torch.no_grad()
def project(module: nn.Module, unit_heads: Iterable[nn.Linear] = ()) -> None:
    """Unit rows, joint norm sqrt(d) of gamma and beta, norm sqrt(d) of the RMS scale.

    Args:
        module: network whose trunks are projected.
        unit_heads: linear maps outside of the trunks with unit rows.
    """
    linears = list(unit_heads)
    for part in module.modules():
        if isinstance(part, PlainTrunk):
            linears.append(part.embed)
        elif isinstance(part, nn.RMSNorm):
            scale = part.weight
            scale.mul_(len(scale) ** 0.5 * torch.rsqrt(scale.square().sum() + 1e-8))
        elif isinstance(part, PlainBlock):
            linears += [part.linear1, part.linear2]
        elif isinstance(part, PlainBatchNorm):
            total = part.weight.square().sum() + part.bias.square().sum()
            factor = len(part.weight) ** 0.5 * torch.rsqrt(total + 1e-8)
            part.weight.mul_(factor)
            part.bias.mul_(factor)
    for linear in linears:
        weight = linear.weight
        weight.div_(weight.norm(dim=-1, keepdim=True).clamp_min(1e-8))

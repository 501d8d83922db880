"""The future encoder: a window of coming reference frames as one latent vector."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import silu

from flashdex.modules.layers import Mode, held
from flashdex.modules.product import product

KERNELS = (1, 4, 2)
STRIDES = (1, 2, 1)


class FutureEncoder(nn.Module):
    """Three temporal convolutions with SiLU and a linear read-out, for E members.

    1x1 to 128, kernel 4 stride 2 to 64, kernel 2 to 32, flatten, linear to the latent:
    59,488 parameters with 78 channels, 10 frames and latent 128. Ordinary layers with
    bias; neither normalised nor projected.

    Args:
        channels: features C of one frame.
        num_frames: frames K of the window, at least 6.
        latent_dim: size of the output.
        widths: output channels of the three convolutions.
        ensemble: number of members E; all see the same window.

    Example:
        >>> encoder = FutureEncoder(78)
        >>> encoder(torch.randn(4, 78, 10)).shape
        torch.Size([1, 4, 128])
    """

    def __init__(
        self,
        channels: int,
        *,
        num_frames: int = 10,
        latent_dim: int = 128,
        widths: Sequence[int] = (128, 64, 32),
        ensemble: int = 1,
    ) -> None:
        super().__init__()
        self.latent_dim = latent_dim
        self.ensemble = ensemble
        sizes, length = [], num_frames
        fan_channels = channels
        for width, kernel, stride in zip(widths, KERNELS, STRIDES, strict=True):
            sizes.append((fan_channels * kernel, width))
            fan_channels, length = width, (length - kernel) // stride + 1
        sizes.append((fan_channels * length, latent_dim))
        self.weights = nn.ParameterList(
            torch.empty(ensemble, out, fan_in) for fan_in, out in sizes
        )
        self.biases = nn.ParameterList(torch.empty(ensemble, out) for _, out in sizes)
        for weight, bias in zip(self.weights, self.biases, strict=True):
            bound = 1.0 / math.sqrt(weight.shape[-1])
            nn.init.uniform_(weight, -bound, bound)
            nn.init.uniform_(bias, -bound, bound)

    def forward(self, future: Tensor, *, mode: Mode = "train") -> Tensor:
        """Encode ``future`` (B, C, K) to (E, B, latent_dim)."""
        weights = [held(weight, mode) for weight in self.weights]
        biases = [held(bias, mode) for bias in self.biases]
        # frames before channels: each convolution is one product
        frames = future.mT.flatten(0, 1).unsqueeze(0)
        x = product(frames, weights[0].flatten(0, 1)[None], biases[0].flatten()[None])
        x = x.view(len(future), -1, self.ensemble, x.shape[-1] // self.ensemble)
        x = silu(x.movedim(2, 0).contiguous())
        for i in (1, 2):
            x = silu(_convolve(x, weights[i], biases[i], stride=STRIDES[i]))
        return product(x.flatten(2), weights[3], biases[3])


def _convolve(x: Tensor, weight: Tensor, bias: Tensor, *, stride: int) -> Tensor:
    """(E, B, K, C) to (E, B, (K - kernel) // stride + 1, d): a convolution over frames.

    Every frame group times every tap, then a shifted sum. Groups of ``stride`` frames
    do not overlap, so no window has to be copied out. The weight is (E, d, C kernel),
    the kernel a multiple of ``stride``.
    """
    ensemble, batch, frames, channels = x.shape
    groups = frames // stride
    x = x[:, :, : groups * stride].reshape(ensemble, batch * groups, -1)
    # one row per tap and output, over the frames and channels of a group
    taps = weight.shape[-1] // (stride * channels)
    rows = weight.unflatten(-1, (channels, taps, stride)).permute(0, 3, 1, 4, 2)
    rows = rows.flatten(3).flatten(1, 2)
    parts = product(x, rows).view(ensemble, batch, groups, taps, -1)
    length = groups - taps + 1
    out = bias[:, None, None] + parts[:, :, :length, 0]
    for tap in range(1, taps):
        out = out + parts[:, :, tap : tap + length, tap]
    return out

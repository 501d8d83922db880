"""Networks and batches without random numbers: weights and rows from sine formulas."""

from __future__ import annotations

import torch

from flashdex.modules.layers import project_


def grid(rows, columns, function):
    """``function(row, column)``, zero-based, (rows, columns) in float64."""
    row = torch.arange(rows, dtype=torch.float64)[:, None]
    return function(row, torch.arange(columns, dtype=torch.float64))


def fill_weight(weight, phase):
    """Element (e, k, j) becomes ``sin(.37 (k + 1)(j + 2) + phase + .5 e)``."""
    member, row, column = (torch.arange(n, dtype=torch.float64) for n in weight.shape)
    value = 0.37 * (row[:, None] + 1) * (column + 2) + phase
    with torch.no_grad():
        weight.copy_(torch.sin(value + 0.5 * member[:, None, None]))


def fill_networks(actor, critic):
    """Fill all matrices and project; phases 0-4 trunk, 5 and 6 heads."""
    for network in (actor, critic):
        fill_weight(network.trunk.embed.linear.weight, 0)
        for i, block in enumerate(network.trunk.blocks):
            fill_weight(block.linear1.weight, 1 + 2 * i)
            fill_weight(block.linear2.weight, 2 + 2 * i)
    fill_weight(actor.head.weight[:, : actor.action_dim], 5)
    fill_weight(actor.head.weight[:, actor.action_dim :], 6)
    fill_weight(critic.head.weight, 5)
    project_(actor)
    project_(critic)


def observation(rows, columns, shift=0.0):
    """``2 sin(.7 b + 1.3 j + shift) + .5``."""
    return grid(
        rows, columns, lambda b, j: 2 * torch.sin(0.7 * b + 1.3 * j + shift) + 0.5
    )

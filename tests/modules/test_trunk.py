"""The folded first layer and the trunk against torch.nn.functional."""

import pytest
import torch
from torch.nn import functional

from flashdex.modules.embed import InputEmbed
from flashdex.modules.trunk import FlashTrunk


def _scramble(module):
    with torch.no_grad():
        for name, tensor in [*module.named_parameters(), *module.named_buffers()]:
            if "linear" not in name and "mask" not in name:
                tensor.copy_(torch.rand_like(tensor) + 0.5)


def _norm(norm, member, x, training):
    """Plain BatchNorm of one member on copies of its statistics."""
    return functional.batch_norm(
        x,
        norm.running_mean[member].clone(),
        norm.running_var[member].clone(),
        norm.weight[member],
        norm.bias[member],
        training=training,
        momentum=0.01,
        eps=1e-5,
    )


def _plain_trunk(trunk, parts, member, training):
    views = [p if p.dim() == 2 else p[member] for p in parts]
    x = _norm(trunk.embed.norm, member, torch.cat(views, -1), training)
    x = x @ trunk.embed.linear.weight[member].T
    for block in trunk.blocks:
        y = x @ block.linear1.weight[member].T
        y = _norm(block.norm1, member, y, training).relu()
        y = y @ block.linear2.weight[member].T
        x = x + _norm(block.norm2, member, y, training).relu()
    return functional.rms_norm(x, x.shape[-1:], trunk.norm.weight[member], 1e-6)


PARTS = {
    "shared": lambda: [torch.randn(9, 7)],
    "two shared": lambda: [torch.randn(9, 4), torch.randn(9, 3)],
    "shared and own": lambda: [torch.randn(9, 4), torch.randn(3, 9, 3)],
    "own": lambda: [torch.randn(3, 9, 7)],
    "own first": lambda: [torch.randn(3, 9, 2), torch.randn(9, 5)],
}


@pytest.mark.parametrize("mode", ["train", "eval", "frozen"])
@pytest.mark.parametrize("kind", PARTS)
def test_trunk_equals_plain_form(kind, mode):
    torch.manual_seed(0)
    torch.set_default_dtype(torch.float64)
    try:
        trunk = FlashTrunk(7, 6, ensemble=3)
        parts = [p.requires_grad_() for p in PARTS[kind]()]
    finally:
        torch.set_default_dtype(torch.float32)
    _scramble(trunk)
    training = mode == "train"
    expected = torch.stack([_plain_trunk(trunk, parts, e, training) for e in range(3)])
    weights = torch.randn_like(expected)
    targets = [*parts, *([] if mode == "frozen" else trunk.parameters())]
    wanted = torch.autograd.grad((weights * expected).sum(), targets)
    out = trunk(parts, mode=mode)
    assert torch.allclose(out, expected, atol=1e-11)
    found = torch.autograd.grad((weights * out).sum(), targets)
    for a, b in zip(found, wanted, strict=True):
        assert torch.allclose(a, b, atol=1e-10)


@pytest.mark.parametrize("kind", PARTS)
def test_first_layer_tracks_torch_statistics(kind):
    torch.manual_seed(1)
    embed = InputEmbed(7, 6, ensemble=3)
    _scramble(embed)
    parts = PARTS[kind]()
    mean, var = embed.norm.running_mean.clone(), embed.norm.running_var.clone()
    for e in range(3):
        x = torch.cat([p if p.dim() == 2 else p[e] for p in parts], -1)
        functional.batch_norm(x, mean[e], var[e], training=True, momentum=0.01)
    embed(parts, mode="train")
    assert torch.allclose(embed.norm.running_mean, mean, atol=1e-6)
    assert torch.allclose(embed.norm.running_var, var, atol=1e-6)


@pytest.mark.parametrize("mode", ["train", "eval"])
def test_kept_rows_are_rows_of_the_whole(mode):
    torch.manual_seed(2)
    trunk = FlashTrunk(7, 6, ensemble=2)
    x = torch.randn(10, 7)
    whole = trunk([x], mode=mode)
    if mode == "eval":
        assert torch.allclose(trunk([x], mode=mode, keep=slice(5, 10)), whole[:, 5:])
    fresh = FlashTrunk(7, 6, ensemble=2)
    fresh.load_state_dict(trunk.state_dict())
    kept = fresh([x], mode="train", keep=slice(0, 5))
    assert torch.allclose(kept, trunk([x], mode="train")[:, :5], atol=1e-6)


def test_large_offsets_keep_their_digits():
    """A column at 100 +- 0.01 is normalised as well in float32 as in float64."""
    torch.manual_seed(3)
    embed = InputEmbed(4, 8, ensemble=2)
    x = 100 + 0.01 * torch.randn(64, 4)
    with torch.no_grad():
        embed.norm.running_mean.copy_(x.double().mean(0).float())
        embed.norm.running_var.copy_(x.double().var(0).float())
    double = InputEmbed(4, 8, ensemble=2).double()
    double.load_state_dict(embed.state_dict())
    for mode in ("eval", "train"):
        single = embed([x], mode=mode).double()
        assert (single - double([x.double()], mode=mode)).abs().max() < 5e-3
        double.load_state_dict(embed.state_dict())


def test_constant_columns_are_silent_in_train_mode():
    embed = InputEmbed(3, 5)
    x = torch.randn(16, 3)
    x[:, 1] = 7.0
    y = x.clone()
    y[:, 1] = -2.0
    assert torch.allclose(embed([x], mode="train"), embed([y], mode="train"), atol=1e-5)


def test_masked_columns_do_not_reach_their_member():
    mask = torch.tensor([[1.0, 1.0, 0.0], [1.0, 0.0, 1.0]])
    embed = InputEmbed(3, 5, ensemble=2, column_mask=mask)
    x = torch.randn(8, 3, requires_grad=True)
    for mode in ("train", "eval"):
        out = embed([x], mode=mode)
        (grad,) = torch.autograd.grad(out[0].square().sum(), x)
        assert torch.equal(grad[:, 2], torch.zeros(8))
        assert grad[:, :2].abs().sum() > 0
    assert torch.allclose(embed.linear.weight.norm(dim=-1), torch.ones(2, 5))

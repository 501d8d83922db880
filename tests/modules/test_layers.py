"""Primitive layers against torch.nn.functional and closed forms."""

import pytest
import torch
from torch.nn import functional

from flashdex.modules.dense import linear_norm_relu
from flashdex.modules.layers import (
    UnitBatchNorm,
    UnitLinear,
    UnitRMSNorm,
    dense_relu,
    project_,
    warm_up_statistics,
)


def _randomise(module):
    with torch.no_grad():
        for tensor in [*module.parameters(), *module.buffers()]:
            tensor.copy_(torch.rand_like(tensor) + 0.5)


@pytest.mark.parametrize(("inside", "outside"), [(7, 3), (3, 7)])
def test_unit_linear_starts_with_unit_rows(inside, outside):
    torch.manual_seed(0)
    layer = UnitLinear(inside, outside, ensemble=2)
    assert torch.allclose(layer.weight.norm(dim=-1), torch.ones(2, outside))
    assert not torch.allclose(layer.weight[0], layer.weight[1])
    if inside >= outside:
        gram = layer.weight @ layer.weight.mT
        assert torch.allclose(gram, torch.eye(outside).expand(2, -1, -1), atol=1e-6)


def test_unit_linear_is_a_product_per_member():
    layer = UnitLinear(3, 5, ensemble=2)
    x = torch.randn(2, 7, 3)
    expected = torch.stack([functional.linear(x[e], layer.weight[e]) for e in range(2)])
    assert torch.allclose(layer(x), expected, atol=1e-6)


def test_projection_restores_every_norm():
    torch.manual_seed(1)
    net = torch.nn.ModuleList(
        [UnitLinear(4, 6, ensemble=3), UnitBatchNorm(6, ensemble=3)]
    )
    net.append(UnitRMSNorm(6, ensemble=3))
    _randomise(net)
    direction = net[0].weight / net[0].weight.norm(dim=-1, keepdim=True)
    ratio = net[1].weight / net[1].bias
    project_(net)
    assert torch.allclose(net[0].weight, direction.detach(), atol=1e-6)
    joint = net[1].weight.square().sum(-1) + net[1].bias.square().sum(-1)
    assert torch.allclose(joint, torch.full((3,), 6.0), atol=1e-5)
    assert torch.allclose(net[1].weight / net[1].bias, ratio, atol=1e-5)
    assert torch.allclose(net[2].weight.norm(dim=-1), torch.full((3,), 6**0.5))


def test_projection_of_a_zero_row_stays_finite():
    layer = UnitLinear(4, 2)
    with torch.no_grad():
        layer.weight[0, 0] = 0
    layer.project_()
    assert torch.equal(layer.weight[0, 0], torch.zeros(4))


def test_rms_norm_matches_torch():
    norm = UnitRMSNorm(8, ensemble=2)
    _randomise(norm)
    x = 3 * torch.randn(2, 5, 8)
    expected = torch.stack(
        [functional.rms_norm(x[e], (8,), norm.weight[e], 1e-6) for e in range(2)]
    )
    assert torch.allclose(norm(x), expected, atol=1e-6)


@pytest.mark.parametrize("mode", ["train", "eval", "frozen"])
def test_dense_relu_matches_torch_batch_norm(mode):
    torch.manual_seed(2)
    linear = UnitLinear(4, 6, ensemble=3).double()
    norm = UnitBatchNorm(6, ensemble=3).double()
    _randomise(norm)
    mean, var = norm.running_mean.clone(), norm.running_var.clone()
    x = torch.randn(3, 11, 4, dtype=torch.float64)
    expected = torch.stack(
        [
            functional.batch_norm(
                x[e] @ linear.weight[e].T,
                mean[e],
                var[e],
                norm.weight[e],
                norm.bias[e],
                training=mode == "train",
                momentum=0.01,
                eps=1e-5,
            ).relu()
            for e in range(3)
        ]
    )
    out = dense_relu(linear, norm, x, mode=mode)
    assert torch.allclose(out, expected, atol=1e-12)
    # torch moved mean and var in place exactly as ours must have moved
    assert torch.allclose(norm.running_mean, mean, atol=1e-14)
    assert torch.allclose(norm.running_var, var, atol=1e-14)
    kept = dense_relu(linear, norm, x, mode="eval", keep=slice(0, 4))
    whole = dense_relu(linear, norm, x, mode="eval")
    assert torch.allclose(kept, whole[:, :4])


@pytest.mark.parametrize("keep", [None, slice(0, 4), slice(4, 8)], ids=str)
@pytest.mark.parametrize("outputs", [3, 5])
def test_linear_norm_relu_gradient(keep, outputs):
    """Finite differences, with the statistics taken on either side of the product."""
    torch.manual_seed(3)
    x = torch.randn(2, 8, 4, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(2, outputs, 4, dtype=torch.float64, requires_grad=True)
    gamma = torch.rand(2, outputs, dtype=torch.float64, requires_grad=True)
    beta = torch.randn(2, outputs, dtype=torch.float64, requires_grad=True)

    def output(*inputs):
        return linear_norm_relu(*inputs, eps=1e-5, keep=keep)[0]

    assert torch.autograd.gradcheck(output, (x, weight, gamma, beta))


@pytest.mark.parametrize("outputs", [3, 5])
def test_linear_norm_relu_returns_the_statistics_of_the_product(outputs):
    torch.manual_seed(4)
    x = 3 + torch.randn(2, 8, 4, dtype=torch.float64)
    weight = torch.randn(2, outputs, 4, dtype=torch.float64)
    ones = torch.ones(2, outputs, dtype=torch.float64)
    _, mean, var = linear_norm_relu(x, weight, ones, ones, eps=1e-5)
    z = torch.einsum("ebk,edk->ebd", x, weight)
    assert torch.allclose(mean, z.mean(1), atol=1e-12)
    assert torch.allclose(var, z.var(1, correction=0), atol=1e-12)


def test_frozen_mode_reaches_inputs_only():
    linear, norm = UnitLinear(4, 6), UnitBatchNorm(6)
    x = torch.randn(1, 5, 4, requires_grad=True)
    dense_relu(linear, norm, x, mode="frozen").sum().backward()
    assert x.grad is not None
    assert linear.weight.grad is None
    assert norm.weight.grad is None
    assert norm.bias.grad is None


def test_warm_statistics_are_plain_means_until_the_momentum_takes_over():
    norm = UnitBatchNorm(3, ensemble=2)
    warm_up_statistics(norm)
    means, variances = torch.randn(130, 2, 3), torch.rand(130, 2, 3)
    for mean, var in zip(means[:100], variances[:100], strict=True):
        norm.track_(mean, var, 11)
    torch.testing.assert_close(norm.running_mean, means[:100].mean(0))
    torch.testing.assert_close(norm.running_var, variances[:100].mean(0) * 1.1)
    expected = means[:100].mean(0)
    for mean, var in zip(means[100:], variances[100:], strict=True):
        norm.track_(mean, var, 11)
        expected = 0.99 * expected + 0.01 * mean
    torch.testing.assert_close(norm.running_mean, expected)

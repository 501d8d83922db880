"""Products of members: the fast kernels, their fallbacks and their gradients."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from flashdex.modules.product import (
    bfloat16_products,
    multiply,
    multiply_rows,
    product,
)

# large enough for the fast float32 kernels, and small
SHAPES = {"large": (2, 160, 150, 140), "one": (1, 160, 150, 140), "small": (3, 5, 4, 6)}
LAYOUTS = {
    "dense": lambda t: t,
    "transposed": lambda t: t.mT.contiguous().mT,
    "slice": lambda t: torch.cat([t, t], -1)[..., : t.shape[-1]],
}


def _operands(shape):
    members, rows, inner, columns = shape
    torch.manual_seed(0)
    x, weight = torch.randn(members, rows, inner), torch.randn(members, columns, inner)
    return x, weight, torch.randn(members, columns)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("shape", SHAPES)
def test_multiply_in_every_layout(shape, layout):
    x, weight, bias = _operands(SHAPES[shape])
    wanted = torch.einsum("ebk,edk->ebd", x.double(), weight.double())
    x, weight = LAYOUTS[layout](x), LAYOUTS[layout](weight)
    assert torch.allclose(multiply(x, weight).double(), wanted, atol=1e-4)
    wanted = wanted + bias[:, None]
    assert torch.allclose(multiply(x, weight, bias).double(), wanted, atol=1e-4)
    out = multiply(x, weight, bias, relu=True)
    assert torch.allclose(out.double(), wanted.relu(), atol=1e-4)
    assert out.is_contiguous()


@pytest.mark.parametrize(("left", "right"), [(150, 160), (160, 150)])
def test_multiply_rows_is_a_transposed_product(left, right):
    a, b = torch.randn(2, 140, left), torch.randn(2, 140, right)
    wanted = torch.einsum("ebn,ebk->enk", a.double(), b.double())
    assert torch.allclose(multiply_rows(a, b).double(), wanted, atol=1e-4)


@pytest.mark.parametrize("relu", [False, True])
def test_gradients_by_finite_differences(relu):
    inputs = [t.double().requires_grad_() for t in _operands(SHAPES["small"])]
    assert torch.autograd.gradcheck(lambda *a: product(*a, relu=relu), inputs)


@pytest.mark.parametrize("relu", [False, True])
def test_float32_gradients_equal_float64(relu):
    single = [t.requires_grad_() for t in _operands(SHAPES["large"])]
    double = [t.detach().double().requires_grad_() for t in single]
    found, wanted = (
        torch.autograd.grad(product(*tensors, relu=relu).square().sum(), tensors)
        for tensors in (single, double)
    )
    for a, b in zip(found, wanted, strict=True):
        assert (a - b).abs().max() < 1e-4 * b.abs().max()


def test_what_needs_no_gradient_gets_none():
    x, weight, _ = _operands(SHAPES["small"])
    product(x.requires_grad_(), weight).sum().backward()
    assert x.grad is not None
    assert weight.grad is None


def test_bfloat16_products_round_large_ones_and_end_with_their_block():
    x, weight, bias = _operands(SHAPES["large"])
    exact = product(x, weight, bias)
    with bfloat16_products():
        rounded = product(x, weight, bias)
        with bfloat16_products(False):  # an inner block does not switch it off
            assert torch.equal(product(x, weight, bias), rounded)
        with ThreadPoolExecutor(1) as other:
            assert torch.equal(other.submit(product, x, weight, bias).result(), exact)
    operands = x.bfloat16().double(), weight.bfloat16().double()
    wanted = torch.einsum("ebk,edk->ebd", *operands) + bias[:, None]
    assert torch.allclose(rounded.double(), wanted, atol=0.2)
    assert rounded.dtype == torch.float32
    assert not torch.equal(rounded, exact)
    with pytest.raises(RuntimeError), bfloat16_products():
        raise RuntimeError
    assert torch.equal(product(x, weight, bias), exact)


def test_gradients_are_rounded_as_their_product_was():
    x, weight, _ = _operands(SHAPES["large"])
    x.requires_grad_()
    (exact,) = torch.autograd.grad(product(x, weight).sum(), x)
    with bfloat16_products():
        out = product(x, weight)
    (rounded,) = torch.autograd.grad(out.sum(), x)
    assert not torch.equal(exact, rounded)
    wanted = weight.bfloat16().double().sum(1, keepdim=True).expand_as(rounded)
    assert torch.allclose(rounded.double(), wanted, atol=0.2)


def test_small_products_are_never_rounded():
    x, weight, bias = _operands(SHAPES["small"])
    with bfloat16_products():
        out = product(x, weight, bias)
    assert torch.equal(out, product(x, weight, bias))

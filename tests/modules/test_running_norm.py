"""Running input statistics against one pass over all rows."""

import pytest
import torch

from flashdex.modules.gaussian_policy import RunningNorm


def test_merged_moments_are_those_of_all_rows():
    torch.manual_seed(0)
    parts = [torch.randn(n, 5) * torch.tensor([1e-2, 1, 3, 10, 0]) + n for n in (7, 90)]
    norm = RunningNorm(5)
    for part in parts:
        norm.update(part)
    rows = torch.cat(parts).double()
    torch.testing.assert_close(norm.mean, rows.mean(0))
    torch.testing.assert_close(norm.var, rows.var(0, correction=0))
    x = torch.cat(parts)
    expected = (rows - rows.mean(0)) / (rows.var(0, correction=0) + 1e-6).sqrt()
    torch.testing.assert_close(norm(x), expected.float(), atol=1e-4, rtol=1e-4)


def test_windows_are_normalised_by_channel():
    torch.manual_seed(0)
    x = torch.randn(50, 3, 4) * torch.tensor([1.0, 5, 20])[:, None] + 7
    norm = RunningNorm(3)
    norm.update(x)
    out = norm(x)
    assert out.shape == x.shape
    assert out.mean((0, 2)).abs().max() < 1e-5
    torch.testing.assert_close(out.std((0, 2), correction=0), torch.ones(3))


@pytest.mark.parametrize("before", [0, 7])
def test_no_rows_change_nothing(before):
    norm = RunningNorm(3)
    if before:
        norm.update(torch.randn(before, 3, 2))
    kept = {k: v.clone() for k, v in norm.state_dict().items()}
    norm.update(torch.randn(0, 3, 2))
    assert all(torch.equal(v, kept[k]) for k, v in norm.state_dict().items())


@pytest.mark.parametrize(("value", "expected"), [(3.0, 3.0), (99.0, 10.0)])
def test_before_any_row_the_input_is_only_clipped(value, expected):
    out = RunningNorm(2)(torch.full((1, 2), value))
    torch.testing.assert_close(out, torch.full((1, 2), expected))

"""The categorical projection against golden values and brute force."""

import pytest
import torch

from flashdex.objectives.terms import categorical_projection


def _project(prob, reward, entropy_cost, terminated, discount=0.99):
    def tensor(x):
        return torch.as_tensor(x, dtype=prob.dtype).expand(prob.shape[:-1])

    return categorical_projection(
        prob,
        reward=tensor(reward),
        discount=tensor(discount),
        terminated=tensor(terminated),
        entropy_cost=tensor(entropy_cost),
        v_max=5.0,
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize(
    ("atom", "reward", "entropy", "terminated", "expected"),
    [
        (50, 0.123, 0.2, 0.0, {49: 0.75, 50: 0.25}),
        (100, 0.5, -0.3, 0.0, {100: 1.0}),
        (0, -1.0, 0.0, 1.0, {40: 1.0}),
    ],
)
def test_golden(atom, reward, entropy, terminated, expected, dtype):
    prob = torch.zeros(1, 101, dtype=dtype)
    prob[0, atom] = 1
    out = _project(prob, reward, entropy, terminated)
    wanted = torch.zeros(1, 101, dtype=dtype)
    for index, mass in expected.items():
        wanted[0, index] = mass
    assert torch.allclose(out, wanted, atol=1e-12 if dtype == torch.float64 else 1e-4)


@pytest.mark.parametrize("size", [7, 101])
def test_brute_force_mass_and_mean(size):
    torch.manual_seed(0)
    prob = torch.randn(3, size, 101, dtype=torch.float64).softmax(-1)
    reward = 3 * torch.randn(3, size, dtype=torch.float64)
    cost = torch.randn(3, size, dtype=torch.float64)
    discount = torch.rand(size, dtype=torch.float64)
    terminated = (torch.rand(size) > 0.7).double()
    out = categorical_projection(
        prob,
        reward=reward,
        discount=discount,
        terminated=terminated,
        entropy_cost=cost,
        v_max=5.0,
    )
    atoms = torch.linspace(-5, 5, 101, dtype=torch.float64)
    wanted = torch.zeros_like(prob)
    for g in range(3):
        for b in range(size):
            carry = discount[b] * (1 - terminated[b])
            moved = (reward[g, b] + carry * (atoms - cost[g, b])).clamp(-5, 5)
            # triangular kernel: the same split without floor and scatter
            share = (1 - (moved[:, None] - atoms).abs() / 0.1).clamp_min(0)
            wanted[g, b] = prob[g, b] @ share
    assert torch.allclose(out, wanted, atol=1e-10)
    assert torch.allclose(out.sum(-1), torch.ones(3, size, dtype=torch.float64))


def test_mean_is_kept_inside_and_terminal_rows_collapse():
    torch.manual_seed(1)
    atoms = torch.linspace(-5, 5, 101, dtype=torch.float64)
    prob = torch.softmax(-((atoms - 0.5) ** 2) * 5, 0)[None]
    out = _project(prob, 0.7, 0.2, 0.0, 0.9)
    assert (out @ atoms).item() == pytest.approx(
        0.7 + 0.9 * ((prob @ atoms).item() - 0.2), abs=1e-6
    )
    end = _project(prob, 0.73, 9.0, 1.0)
    assert end[0, 57].item() == pytest.approx(0.7)
    assert end[0, 58].item() == pytest.approx(0.3)


def test_clipped_ends_hold_all_mass():
    prob = torch.full((1, 101), 1 / 101)
    assert _project(prob, 50.0, 0.0, 0.0)[0, 100].item() == pytest.approx(1)
    assert _project(prob, -50.0, 0.0, 0.0)[0, 0].item() == pytest.approx(1)

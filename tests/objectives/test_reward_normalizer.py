"""The reward normaliser against golden values and a plain loop."""

import pytest
import torch

from flashdex.objectives.reward_normalizer import RewardNormalizer

REWARDS, DONES = [1.0, 1.0, 2.0, -1.0, 1.0], [0, 0, 1, 0, 0]


def test_golden():
    norm = RewardNormalizer(1, gamma=0.99)
    rows = []
    for reward, done in zip(REWARDS, DONES, strict=True):
        norm.update(torch.tensor([[reward]]), torch.tensor([bool(done)]))
        state = (norm.returns, norm.returns_max, norm.var, norm.denominator())
        rows.append([x.item() for x in state])
    wanted = [
        [1, 1, 1e-4, 0.2],
        [1.99, 1.99, 0.245075, 0.495051],
        [2, 2, 0.220064, 0.469110],
        [0.98, 2, 0.252605, 0.502599],
        [1.9702, 2, 0.238601, 0.488468],
    ]
    assert torch.allclose(torch.tensor(rows), torch.tensor(wanted), atol=6e-7)


def test_streams_are_independent():
    torch.manual_seed(0)
    pair, one = RewardNormalizer(6, 2, gamma=0.9), RewardNormalizer(6, 1, gamma=0.9)
    for _ in range(30):
        reward, done = torch.randn(6, 2), torch.rand(6, 1) > 0.8
        pair.update(reward * torch.tensor([1.0, 50.0]), done)
        one.update(reward[:, :1], done)
    assert torch.equal(pair.denominator()[:1], one.denominator())
    assert pair.denominator()[1] > 10 * one.denominator()[0]


def test_many_envs_match_pooled_statistics():
    """With the prior forgotten the variance is that of all returns so far."""
    torch.manual_seed(1)
    norm, all_returns, current = RewardNormalizer(32, gamma=0.95), [], torch.zeros(32)
    for _ in range(200):
        reward, done = torch.randn(32), torch.rand(32) > 0.9
        norm.update(reward[:, None], done)
        current = 0.95 * torch.where(done, 0.0, current) + reward
        all_returns.append(current)
    pooled = torch.cat(all_returns).double()
    assert norm.mean.item() == pytest.approx(pooled.mean().item(), abs=1e-5)
    assert norm.var.item() == pytest.approx(pooled.var(correction=0).item(), rel=1e-4)
    bound = max(pooled.std(correction=0).item(), pooled.abs().max().item() / 5)
    assert norm.denominator().item() == pytest.approx(bound, rel=1e-4)


def test_masked_entries_do_not_count():
    torch.manual_seed(2)
    masked, small = RewardNormalizer(5, gamma=0.9), RewardNormalizer(3, gamma=0.9)
    mask = torch.tensor([1, 1, 0, 1, 0], dtype=torch.bool)[:, None]
    never = RewardNormalizer(5, gamma=0.9)
    for _ in range(20):
        reward, done = torch.randn(5, 1), torch.rand(5) > 0.8
        masked.update(torch.where(mask, reward, 100.0), done, mask)
        small.update(reward[mask[:, 0]], done[mask[:, 0]])
        never.update(reward, done, torch.zeros_like(mask))
    assert torch.allclose(masked.denominator(), small.denominator())
    assert torch.allclose(masked.var, small.var)
    assert never.count.item() == 0
    assert never.var.item() == 1


def test_resume_clears_unfinished_returns_only():
    norm = RewardNormalizer(2, gamma=0.9)
    norm.update(torch.ones(2, 1), torch.zeros(2))
    before = norm.denominator()
    norm.clear_returns()
    assert torch.equal(norm.returns, torch.zeros_like(norm.returns))
    assert torch.equal(norm.denominator(), before)

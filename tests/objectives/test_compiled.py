"""Compiled and autocast learners, at sizes where the fast products are used."""

from __future__ import annotations

import pytest
import torch

from benchmarks.learner import LearnerSize, make_batch, make_loss
from flashdex.modules import product
from flashdex.objectives.stepper import FlashSACStepper

SIZE = LearnerSize(40, 3, 1, 128, 64, 32)


def test_autocast_stays_near_float32():
    """Products are rounded to 3 digits; what is kept is float32."""
    torch.manual_seed(0)
    losses = [make_loss(SIZE) for _ in range(2)]
    losses[1].load_state_dict(losses[0].state_dict())
    steppers = [
        FlashSACStepper(loss, autocast=flag)
        for loss, flag in zip(losses, (False, True), strict=True)
    ]
    for seed in range(4):
        td = make_batch(SIZE, seed=seed)
        noise = {n: torch.randn(1, 128, 3) for n in ("actor_noise", "target_noise")}
        exact, rounded = (stepper.update(td, **noise) for stepper in steppers)
        for name in ("loss_qvalue", "loss_actor", "entropy"):
            a, b = exact["group0", name], rounded["group0", name]
            torch.testing.assert_close(a, b, rtol=0.02, atol=0.02)
        assert exact["group0", "loss_qvalue"] != rounded["group0", "loss_qvalue"]
    for value in losses[1].state_dict().values():
        assert value.dtype == torch.float32


@pytest.mark.slow
@pytest.mark.parametrize(("autocast", "tolerance"), [(False, 1e-3), (True, 2e-2)])
def test_compiled_equals_eager_in_float32(autocast, tolerance):
    torch.manual_seed(0)
    losses = [make_loss(SIZE) for _ in range(2)]
    losses[1].load_state_dict(losses[0].state_dict())
    wide = losses[0].qvalue_network.trunk.blocks[0].linear1.weight
    assert 2 * SIZE.batch * wide[0].numel() >= product._LARGE
    torch.compiler.reset()
    eager, compiled = (
        FlashSACStepper(loss, compile=flag, autocast=autocast)
        for loss, flag in zip(losses, (False, True), strict=True)
    )
    for seed in range(4):
        td = make_batch(SIZE, seed=seed)
        shape = (SIZE.groups, SIZE.batch, SIZE.action)
        noise = {n: torch.randn(shape) for n in ("actor_noise", "target_noise")}
        a, b = eager.update(td, **noise), compiled.update(td, **noise)
        for key in a.keys(True, True):
            # Adam turns rounding into steps of its rate, 3e-4
            torch.testing.assert_close(a[key], b[key], atol=tolerance, rtol=tolerance)

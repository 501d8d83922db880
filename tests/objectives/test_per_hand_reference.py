"""The stacked learner against the plain one of `benchmarks`, and recorded losses.

Three links: the plain learner with one hand gives the published numbers of
`test_golden_trace`; the stacked one with two hands equals it, parameters and running
statistics included; and the losses that both gave are recorded, so that a change of the
stacked learner that a change of the plain one follows is seen too.
"""

import pytest
import torch
from formulas import fill_networks, grid, observation
from tensordict import TensorDict

from benchmarks.common.plain_flashsac import PlainLearner, read_batch
from flashdex.modules.actor import FlashActor
from flashdex.modules.critic import EnsembleCritic
from flashdex.modules.future import FutureEncoder
from flashdex.objectives.flashsac import FlashSACLoss
from flashdex.objectives.stepper import FlashSACStepper

ROWS, OBS, ACT = 16, 5, 2
SIDES = ("left", "right")
ALPHAS = (0.01, 0.02, 0.03)

# ``_formula_loss``, ``_formula_batch`` and ``_formula_noise`` for two hands, float64,
# the same batch in all eight updates, [left, right]. Written down on 2026-11-22 from a
# run in which the learner and explicit loops over rows and atoms differed by less than
# 1e-12. Actor values: updates 0, 2, 4, 6. "ungated" is ``own_action_gate=False``.
RECORDED = {
    "gated": {
        "loss_actor": [
            (0.132003747, 0.143345847),
            (0.129785376, 0.139494315),
            (0.127486123, 0.135062332),
            (0.125093218, 0.130666563),
        ],
        "entropy": [
            (-6.972654905, -5.968586810),
            (-6.903755351, -5.821165577),
            (-6.836601161, -5.674877586),
            (-6.769890950, -5.531932548),
        ],
        "loss_qvalue": [
            (5.145768267, 5.069820000),
            (5.120960726, 5.057019470),
            (5.102545685, 5.045407931),
            (5.084681690, 5.033883796),
            (5.069291525, 5.023214558),
            (5.057548160, 5.012513130),
            (5.045075266, 5.002831618),
            (5.031393666, 4.993028446),
        ],
    },
    "ungated": {
        "loss_actor": [
            (0.132003747, 0.143345847),
            (0.129471790, 0.139434234),
            (0.126807149, 0.134982539),
            (0.123952901, 0.130609946),
        ],
        "entropy": [
            (-6.972654905, -5.968586810),
            (-6.907230388, -5.824661430),
            (-6.841293197, -5.685283355),
            (-6.774407330, -5.552749667),
        ],
        "loss_qvalue": [
            (5.145819809, 5.069726905),
            (5.121001186, 5.056934259),
            (5.102652202, 5.045238096),
            (5.084790012, 5.033736616),
            (5.069389548, 5.022925619),
            (5.057727365, 5.012231005),
            (5.045188649, 5.002470089),
            (5.031473978, 4.992692872),
        ],
    },
}


def _double(loss, num_groups):
    """Float64 without the rounding of float32 in atoms and temperatures."""
    loss = loss.double()
    atoms = torch.linspace(-5, 5, 101, dtype=torch.float64)
    alphas = torch.tensor(ALPHAS[:num_groups], dtype=torch.float64)
    with torch.no_grad():
        loss.qvalue_network.atoms.copy_(atoms)
        loss.target_qvalue_network.atoms.copy_(atoms)
        loss.log_alpha.copy_(alphas.log())
    return loss


def _formula_loss(groups, *, gate=True):
    """The golden networks; member e of all matrices has phase 0.5 e."""
    num = 1 if groups is None else len(groups)
    actor = FlashActor(OBS, ACT, num_groups=num, width=8, head="unit").double()
    critic = EnsembleCritic(OBS, ACT, num_groups=num, width=16).double()
    fill_networks(actor, critic)
    loss = FlashSACLoss(actor, critic, groups=groups, gamma=0.99, own_action_gate=gate)
    return _double(loss, num)


def _formula_batch(groups):
    """The golden batch; hand h has phase 0.9 h and reward times 1 + h."""
    row = torch.arange(ROWS, dtype=torch.float64)
    following = {
        "observation": observation(ROWS, OBS, 0.4),
        "terminated": (row % 5 == 0)[:, None],
    }
    td = TensorDict({"observation": observation(ROWS, OBS), "next": following}, [ROWS])
    for h, path in enumerate([()] if groups is None else [(g,) for g in groups]):
        shift = 0.9 * h
        action = grid(ROWS, ACT, lambda b, j, s=shift: torch.sin(1.1 * b + 0.6 * j + s))
        reward = (1 + h) * torch.cos(0.9 * row + shift)
        td.set((*path, "action"), action)
        td.set(("next", *path, "reward"), reward[:, None])
    if groups is not None:
        td["steps"] = (row % 3 + 1)[:, None].long()
    return td


def _formula_noise(num_groups):
    """``1.5 sin(2.1 b + .8 j + h)`` and ``1.5 cos(1.7 b + .5 j + h)``, (H, B, A)."""
    actor, target = [], []
    for h in range(num_groups):
        phase = grid(ROWS, ACT, lambda b, j, h=h: 2.1 * b + 0.8 * j + h)
        actor.append(1.5 * phase.sin())
        phase = grid(ROWS, ACT, lambda b, j, h=h: 1.7 * b + 0.5 * j + h)
        target.append(1.5 * phase.cos())
    return torch.stack(actor), torch.stack(target)


def _noises(actor, target):
    return {"actor_noise": actor, "target_noise": target}


def _assert_runs_agree(loss, batches, noises, *, tolerance):
    """Run both; same losses in every update, same state at the end.

    Returns:
        Per update the learner's ``loss_actor``, ``entropy``, ``loss_qvalue``, one value
        a hand.
    """
    plain, stepper = PlainLearner(loss), FlashSACStepper(loss)
    options = {"atol": tolerance, "rtol": 0}
    trace = []
    for td, pair in zip(batches, noises, strict=True):
        report = stepper.update(td, **_noises(*pair))
        wanted = plain.update(read_batch(td, loss), **_noises(*pair))
        found = {
            name: torch.stack(
                [report[name if g is None else (g, name)] for g in loss.groups]
            )
            for name in ("loss_actor", "entropy", "alpha", "loss_qvalue")
        }
        for name, values in wanted.items():
            torch.testing.assert_close(found[name], values, **options)
        trace.append(found)
    # every parameter and every running statistic, and the temperatures
    found, wanted = PlainLearner(loss).state_dict(), plain.state_dict()
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        torch.testing.assert_close(found[name], value, **options)
    return trace


def test_the_plain_learner_of_one_hand_gives_the_published_trace():
    """Anchors it: numbers of flashsac.md 14.2, from the published code."""
    loss = _formula_loss(None)
    plain, batch = PlainLearner(loss), read_batch(_formula_batch(None), loss)
    noise = _noises(*_formula_noise(1))
    reports = [plain.update(batch, **noise) for _ in range(4)]
    actor = [r["loss_actor"][0].item() for r in reports[::2]]
    assert actor == pytest.approx([0.131512656, 0.131074022], abs=1e-8)
    entropy = [r["entropy"][0].item() for r in reports[::2]]
    assert entropy == pytest.approx([-6.972654905, -6.888117895], abs=1e-8)
    qvalue = [r["loss_qvalue"][0].item() for r in reports]
    wanted = [5.037813637, 5.016304959, 4.997505242, 4.982784655]
    assert qvalue == pytest.approx(wanted, abs=1e-8)
    assert plain.log_alpha[0].item() == pytest.approx(-4.604570302, abs=1e-8)


@pytest.mark.parametrize("variant", RECORDED)
def test_recorded_trace_of_two_hands(variant):
    loss = _formula_loss(SIDES, gate=variant == "gated")
    batches, noises = [_formula_batch(SIDES)] * 8, [_formula_noise(2)] * 8
    trace = _assert_runs_agree(loss, batches, noises, tolerance=1e-10)
    for name, wanted in RECORDED[variant].items():
        rows = trace if name == "loss_qvalue" else trace[::2]
        found = torch.stack([row[name] for row in rows])
        wanted = torch.tensor(wanted, dtype=torch.float64)
        torch.testing.assert_close(found, wanted, atol=2e-9, rtol=0)


CASES = {
    # 101 rows, as many as atoms: a silent broadcast would show here only
    "as many rows as atoms": {"size": 101, "updates": 2},
    "future, masks, windows": {"future": True, "masked": True, "updates": 5},
    "centred head": {"head": "centred", "updates": 5},
    "one hand": {"groups": ("left",), "future": True, "updates": 3},
    "three hands, no gate": {"groups": ("a", "b", "c"), "gate": False, "updates": 3},
}


def _random_loss(groups, *, future=False, head="unit", gate=True):
    num, channels = len(groups), 4
    encoders = [None, None]
    if future:
        encoders = [FutureEncoder(channels, latent_dim=3, ensemble=n) for n in (num, 1)]
    sizes = {"num_groups": num, "width": 8}
    actor = FlashActor(OBS, ACT, head=head, future_encoder=encoders[0], **sizes)
    critic = EnsembleCritic(OBS, ACT, future_encoder=encoders[1], **sizes)
    loss = FlashSACLoss(actor, critic, groups=groups, gamma=0.9, own_action_gate=gate)
    return _double(loss, num)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_learner_equals_the_plain_one(make_batch, case):
    """Random networks and a new batch every update."""
    torch.manual_seed(0)
    case = dict(case)
    groups, size = case.pop("groups", SIDES), case.pop("size", 16)
    masked, updates = case.pop("masked", False), case.pop("updates")
    batches, noises = [], []
    for seed in range(updates):
        td = make_batch(groups, size=size, seed=seed)
        td = td.apply(lambda x: x.double() if x.is_floating_point() else x)
        if masked:
            td["group_mask"] = torch.rand(size, len(groups)) > 0.4
            td["steps"] = torch.randint(1, 6, (size, 1))
        batches.append(td)
        noises.append(torch.randn(2, len(groups), size, ACT, dtype=torch.float64))
    loss = _random_loss(groups, **case)
    _assert_runs_agree(loss, batches, noises, tolerance=1e-9)

"""Groups are stacked for speed only: taken apart, swapped or alone they do the same."""

import pytest
import torch

from flashdex.objectives.stepper import FlashSACStepper

SIDES = ("left", "right")
OBS, ACT, SIZE = 5, 2, 16
MEMBERS = {"actor_network": 1, "qvalue_network": 2, "target_qvalue_network": 2}


def _draws(make_batch, updates, groups=SIDES):
    """Batches and noises of some updates in float64."""
    generator = torch.Generator().manual_seed(7)
    for seed in range(updates):
        td = make_batch(groups, seed=seed)
        td = td.apply(lambda x: x.double() if x.is_floating_point() else x)
        shape = (2, 2, SIZE, ACT)
        yield td, torch.randn(shape, generator=generator, dtype=torch.float64)


def _rearranged(state, groups, columns):
    """State of a learner that holds only ``groups`` of two, in this order.

    Args:
        state: state dict of a loss with two groups.
        groups: indices of the groups to keep.
        columns: input columns of the critics to keep.
    """
    result = {}
    for name, value in state.items():
        network, _, entry = name.partition(".")
        members = MEMBERS.get(network, 1)
        if network != "actor_network" and "future_encoder" in entry:
            result[name] = value.clone()  # one encoder for all critics
            continue
        index = [g * members + m for g in groups for m in range(members)]
        value = value[index]
        wide = value.shape[-1] > 1  # a counter has no columns
        if network != "actor_network" and "embed" in entry and wide:
            value = value[..., columns]
        result[name] = value.clone()
    return result


def _columns(groups, latent=0):
    actions = [OBS + latent + ACT * g + j for g in groups for j in range(ACT)]
    return [*range(OBS + latent), *actions]


def _assert_close(found, wanted):
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        torch.testing.assert_close(found[name], value, atol=1e-9, rtol=0, msg=name)


def _run_apart(make_loss, make_batch, updates):
    """Two own-action groups stacked and as two learners; their losses and states."""
    torch.manual_seed(0)
    stacked = make_loss(critic_action="own").double()
    alone = [make_loss((side,)).double() for side in SIDES]
    for h, loss in enumerate(alone):
        state = stacked.state_dict()
        loss.load_state_dict(_rearranged(state, [h], _columns([h])))
    steppers = [FlashSACStepper(loss) for loss in (stacked, *alone)]
    for stepper in steppers[1:]:
        # The stacked critic loss is the mean over groups. Adam cancels that factor of
        # a half once its eps grows by the same factor.
        stepper.critic_optimizer.adam.param_groups[0]["eps"] *= 2
    pairs = []
    for td, noise in _draws(make_batch, updates):
        whole = steppers[0].update(td, actor_noise=noise[0], target_noise=noise[1])
        for h, side in enumerate(SIDES):
            own = noise[:, h : h + 1]
            part = steppers[1 + h].update(td, actor_noise=own[0], target_noise=own[1])
            pairs.append((whole[side], part[side]))
    states = [
        (_rearranged(stacked.state_dict(), [h], _columns([h])), loss.state_dict())
        for h, loss in enumerate(alone)
    ]
    return pairs, states


def test_own_action_groups_are_independent_in_the_first_update(make_loss, make_batch):
    pairs, states = _run_apart(make_loss, make_batch, 1)
    for whole, part in pairs:
        _assert_close(whole.to_dict(), part.to_dict())
    for whole, part in states:
        towers = [name for name in whole if name.startswith("actor_network")]
        _assert_close({n: whole[n] for n in towers}, {n: part[n] for n in towers})


def test_own_action_groups_are_independent_learners(make_loss, make_batch):
    pairs, states = _run_apart(make_loss, make_batch, 6)
    for whole, part in pairs:
        _assert_close(whole.to_dict(), part.to_dict())
    for whole, part in states:
        _assert_close(whole, part)


@pytest.mark.parametrize("critic_action", ["joint", "own"])
@pytest.mark.parametrize("gate", [True, False], ids=["gated", "ungated"])
def test_swapping_groups_permutes_whole_runs(
    make_loss, make_batch, critic_action, gate
):
    options = {"critic_action": critic_action, "own_action_gate": gate, "future": True}
    torch.manual_seed(1)
    loss, swapped = (make_loss(g, **options).double() for g in (SIDES, SIDES[::-1]))
    latent = loss.qvalue_network.future_encoder.latent_dim
    order = [1, 0], _columns([1, 0], latent)
    swapped.load_state_dict(_rearranged(loss.state_dict(), *order))
    first, second = FlashSACStepper(loss), FlashSACStepper(swapped)
    for td, noise in _draws(make_batch, 6):
        a = first.update(td, actor_noise=noise[0], target_noise=noise[1])
        turned = noise[:, [1, 0]]
        b = second.update(td, actor_noise=turned[0], target_noise=turned[1])
        for side in SIDES:
            _assert_close(b[side].to_dict(), a[side].to_dict())
    _assert_close(swapped.state_dict(), _rearranged(loss.state_dict(), *order))


@pytest.mark.parametrize("critic_action", ["joint", "own"])
def test_one_named_group_is_the_plain_learner(make_loss, make_batch, critic_action):
    """Bit-equal, and the published trace of `test_golden_trace` holds the plain one."""
    torch.manual_seed(2)
    plain = make_loss(None, future=True)
    named = make_loss(("left",), future=True, critic_action=critic_action)
    named.load_state_dict(plain.state_dict())
    steppers = [
        FlashSACStepper(loss, generator=torch.Generator().manual_seed(0))
        for loss in (plain, named)
    ]
    for seed in range(5):
        td = make_batch(None, seed=seed)
        a = steppers[0].update(td)
        td["left", "action"] = td.pop("action")
        td["next", "left", "reward"] = td["next"].pop("reward")
        b = steppers[1].update(td)
        for name, value in b["left"].items():
            assert torch.equal(value, a[name]), name
    for name, value in plain.state_dict().items():
        assert torch.equal(named.state_dict()[name], value), name

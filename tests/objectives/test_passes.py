"""What each pass of an update reads and moves: halves, statistics, target, gate."""

import copy

import pytest
import torch

from flashdex.modules.policy import FlashPolicy, sample_squashed
from flashdex.objectives.stepper import FlashSACStepper

NETWORKS = ("actor_network", "qvalue_network", "target_qvalue_network")
SIZE, ACT, TAU = 16, 2, 0.1


def _statistics(loss):
    return {k: v.clone() for k, v in loss.state_dict().items() if "running" in k}


def _moved(before, loss):
    """Networks whose running statistics changed; all of a network's, or none."""
    after, result = _statistics(loss), set()
    for network in NETWORKS:
        names = [k for k in before if k.startswith(network)]
        changed = {not torch.equal(before[k], after[k]) for k in names}
        assert len(changed) == 1, network
        result |= {network} if changed.pop() else set()
    return result


def test_statistics_that_each_kind_of_update_moves(make_loss, make_batch):
    """The actor's move only when it steps, one step of momentum 0.01 a pass."""
    loss = make_loss(future=True)
    stepper = FlashSACStepper(loss)
    critics = set(NETWORKS[1:])
    policy = FlashPolicy(loss.actor_network, groups=("left", "right"))
    for update in range(4):
        td = make_batch(seed=update)
        before = _statistics(loss)
        policy(td.clone())
        assert _moved(before, loss) == set()
        stepper.update(td)
        actor = set(NETWORKS[:1]) if update % 2 == 0 else set()
        assert _moved(before, loss) == critics | actor
        rows = torch.cat([td["observation"], td["next", "observation"]])
        for network in critics | actor:
            name = f"{network}.trunk.embed.norm.running_mean"
            old, new = before[name][:, :5], loss.state_dict()[name][:, :5]
            wanted = 0.99 * old + 0.01 * rows.mean(0)
            assert torch.allclose(new, wanted, atol=1e-6), network


def _halves(make_batch):
    """A batch whose s is negative, s' positive and replayed actions are 0.9."""
    td = make_batch()
    td["observation"] = -1 - td["observation"].abs()
    td["next", "observation"] = 1 + td["next", "observation"].abs()
    for side in ("left", "right"):
        td[side, "action"] = torch.full((SIZE, ACT), 0.9)
    return td


def test_order_of_the_halves(make_loss, make_batch):
    """s with replayed actions above s' with fresh ones; the target is the lower half.

    At zero temperature and reward, with discount one, the target is the distribution
    that the target critic gives the least member on the lower half.
    """
    loss, td = make_loss(gamma=1.0), _halves(make_batch)
    for side in ("left", "right"):
        td["next", side, "reward"] = torch.zeros(SIZE, 1)
    td["next", "terminated"] = torch.zeros(SIZE, 1, dtype=torch.bool)
    batch, noise = loss.read(td), torch.randn(2, SIZE, ACT)
    assert (batch.observation[:SIZE] < 0).all()
    assert (batch.observation[SIZE:] > 0).all()
    critic = copy.deepcopy(loss.target_qvalue_network)
    with torch.no_grad():
        loss.log_alpha.fill_(-1e9)  # zero temperature
    target, joint = loss.backup(batch, noise)
    mean, std = loss.actor_network(td["next", "observation"], mode="eval")
    fresh, _ = sample_squashed(mean, std, noise)
    assert torch.equal(joint[:SIZE], torch.full((SIZE, 2 * ACT), 0.9))
    assert torch.allclose(joint[SIZE:], torch.cat([fresh[0], fresh[1]], -1))
    with torch.no_grad():
        prob = critic(batch.observation, joint, mode="train")[:, :, SIZE:].exp()
    for group in range(2):
        value = prob[group] @ critic.atoms
        for row in range(SIZE):
            member = 0 if value[0, row] < value[1, row] else 1
            wanted = prob[group, member, row]
            assert torch.allclose(target[group, row], wanted, atol=2e-5)


def test_critic_loss_is_that_of_the_upper_half(make_loss, make_batch):
    """All rows terminate, so that the target is a point on the reward."""
    loss, td = make_loss(), _halves(make_batch)
    td["next", "terminated"] = torch.ones(SIZE, 1, dtype=torch.bool)
    for side, place in (("left", 40), ("right", 70)):
        atom = loss.qvalue_network.atoms[place].item()
        td["next", side, "reward"] = torch.full((SIZE, 1), atom)
    batch, noise = loss.read(td), torch.randn(2, SIZE, ACT)
    critic = copy.deepcopy(loss.qvalue_network)
    state = {k: v.clone() for k, v in loss.state_dict().items()}
    _, joint = loss.backup(batch, noise)
    loss.load_state_dict(state)
    value, _ = loss.qvalue_loss(td, noise=noise)
    log_p = critic(batch.observation, joint, mode="train")[:, :, :SIZE]
    wanted = -(log_p[0, ..., 40].mean() + log_p[1, ..., 70].mean()) / 2
    assert torch.allclose(value, wanted, atol=2e-4)
    lower = critic(batch.observation, joint, mode="train")[:, :, SIZE:]
    other = -(lower[0, ..., 40].mean() + lower[1, ..., 70].mean()) / 2
    assert (wanted - other).abs() > 1e-2


@pytest.mark.parametrize("gate", [True, False], ids=["gated", "ungated"])
def test_gate_is_what_keeps_towers_apart(make_loss, make_batch, gate):
    """The loss of the left hand alone: the right tower's gradient is exactly zero."""
    loss, td = make_loss(own_action_gate=gate), make_batch()
    td["group_mask"] = torch.tensor([True, False]).expand(SIZE, 2)
    loss.actor_loss(td)[0].backward()
    grads = [p.grad[1].abs().max().item() for p in loss.actor_network.parameters()]
    assert (max(grads) == 0) == gate
    assert loss.actor_network.head.weight.grad[0].abs().max() > 0
    assert all(p.grad is None for p in loss.qvalue_network.parameters())


def test_target_rows_shrink_as_averages_do(make_loss, make_batch):
    """The target is not projected: |w + tau (w' - w)| < 1 between two unit rows."""
    loss = make_loss().double()
    stepper = FlashSACStepper(loss, tau=TAU, lr=3e-2)
    online, target = loss.qvalue_network, loss.target_qvalue_network
    names = [k for k in target.state_dict() if "linear" in k or k == "head.weight"]
    old = {name: target.state_dict()[name].clone() for name in names}
    td = make_batch().apply(lambda x: x.double() if x.is_floating_point() else x)
    stepper.update(td)
    for name in names:
        norm = target.state_dict()[name].norm(dim=-1)
        new = online.state_dict()[name]
        assert torch.allclose(new.norm(dim=-1), torch.ones_like(norm), atol=1e-10)
        cosine = (old[name] * new).sum(-1)
        wanted = (1 - 2 * TAU * (1 - TAU) * (1 - cosine)).sqrt()
        assert torch.allclose(norm, wanted, atol=1e-10)
        assert norm.min() < 1 - 1e-5

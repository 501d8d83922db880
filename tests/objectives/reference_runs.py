"""Take a stacked learner apart into the loops of `per_hand_reference`, and compare."""

from __future__ import annotations

import torch
from per_hand_reference import BatchNorm, Encoder, Network, PerHandFlashSAC

from flashdex.objectives.stepper import FlashSACStepper

KERNELS = (1, 4, 2)


def _own(tensor, member, *shape):
    """A member's slice as a leaf of its own."""
    leaf = tensor.detach()[member].clone().reshape(*shape or tensor.shape[1:])
    return leaf.requires_grad_(tensor.requires_grad)


def _network(net, member, *, unit_head):
    trunk = net.trunk
    norms, weights = [trunk.embed.norm], [trunk.embed.linear.weight]
    for block in trunk.blocks:
        norms += [block.norm1, block.norm2]
        weights += [block.linear1.weight, block.linear2.weight]
    state = [(n.weight, n.bias, n.running_mean, n.running_var) for n in norms]
    return Network(
        [BatchNorm(*(_own(t, member) for t in s)) for s in state],
        [_own(w, member) for w in weights],
        _own(trunk.norm.weight, member),
        _own(net.head.weight, member),
        _own(net.head_bias, member),
        unit_head=unit_head,
    )


def _encoder(encoder, member):
    if encoder is None:
        return None
    *kernels, matrix = encoder.weights
    *biases, offset = encoder.biases
    return Encoder(
        [
            _own(w, member, w.shape[1], -1, k)
            for w, k in zip(kernels, KERNELS, strict=True)
        ],
        [_own(b, member) for b in biases],
        _own(matrix, member),
        _own(offset, member),
    )


def split(loss):
    """Actors, critics and target critics, each with its encoders."""
    actor, hands = loss.actor_network, range(len(loss.groups))
    unit = actor.head_kind == "unit"

    def critics(net):
        # layout [group, member]
        pairs = [
            [_network(net, 2 * h + m, unit_head=True) for m in (0, 1)] for h in hands
        ]
        return pairs, _encoder(net.future_encoder, 0)

    actors = [_network(actor, h, unit_head=unit) for h in hands]
    encoders = [_encoder(actor.future_encoder, h) for h in hands]
    return (
        (actors, encoders),
        critics(loss.qvalue_network),
        critics(loss.target_qvalue_network),
    )


def make_reference(loss):
    """The reference learner at the present state of a fresh ``loss``."""
    actors, critics, _ = split(loss)
    return PerHandFlashSAC(
        actors,
        critics,
        [a.detach().clone() for a in loss.log_alpha],
        log_std=loss.actor_network.log_std_range,
        target_entropy=loss.target_entropy,
        gate=loss.own_action_gate,
    )


def plain_batch(td, loss):
    """What the reference reads, taken from the rows and not through the package."""
    groups = [() if g is None else (g,) for g in loss.groups]
    steps = td.get("steps", torch.ones(len(td), 1))
    mask = td.get("group_mask", torch.ones(len(td), len(groups), dtype=torch.bool))
    reads_future = loss.qvalue_network.future_encoder is not None
    return {
        "state": td["observation"],
        "next_state": td["next", "observation"],
        "window": td["future"] if reads_future else None,
        "next_window": td["next", "future"] if reads_future else None,
        "action": [td[(*g, "action")] for g in groups],
        "reward": [td[("next", *g, "reward")][:, 0] for g in groups],
        "terminated": td["next", "terminated"][:, 0].double(),
        "discount": [loss.gamma ** int(k) for k in steps.flatten()],
        "valid": [mask[:, h].nonzero().flatten() for h in range(len(groups))],
    }


def _leaves(parts):
    if parts is None:
        return []
    if isinstance(parts, list | tuple):
        return [leaf for part in parts for leaf in _leaves(part)]
    return parts.tensors()


def assert_same_state(loss, reference, tolerance):
    """Every parameter and every running statistic, and the temperatures."""
    wanted = (
        (reference.actors, reference.actor_encoders),
        (reference.critics, reference.critic_encoder),
        (reference.targets, reference.target_encoder),
    )
    for a, b in zip(_leaves(split(loss)), _leaves(wanted), strict=True):
        torch.testing.assert_close(a, b, atol=tolerance, rtol=0)
    log_alpha = torch.stack(reference.log_alpha)
    torch.testing.assert_close(
        loss.log_alpha.detach(), log_alpha, atol=tolerance, rtol=0
    )


def assert_runs_agree(loss, batches, noises, *, tolerance):
    """Run both; same losses in every update, same state at the end.

    Returns:
        Per update the learner's ``loss_actor``, ``entropy``, ``loss_qvalue``, one value
        a hand.
    """
    reference, stepper = make_reference(loss), FlashSACStepper(loss)
    trace = []
    for td, (actor_noise, target_noise) in zip(batches, noises, strict=True):
        report = stepper.update(td, actor_noise=actor_noise, target_noise=target_noise)
        wanted = reference.update(plain_batch(td, loss), actor_noise, target_noise)
        found = {
            name: [report[name if g is None else (g, name)].item() for g in loss.groups]
            for name in ("loss_actor", "entropy", "loss_qvalue")
        }
        for name, values in wanted.items():
            pairs = zip(found[name], values, strict=True)
            assert all(abs(a - float(b)) < tolerance for a, b in pairs), name
        trace.append(found)
    assert_same_state(loss, reference, tolerance)
    return trace

"""Four updates without random numbers against the published implementation."""

import pytest
import torch
from formulas import fill_networks, grid, observation
from tensordict import TensorDict

from flashdex.modules.actor import FlashActor
from flashdex.modules.critic import EnsembleCritic
from flashdex.objectives.flashsac import FlashSACLoss
from flashdex.objectives.stepper import FlashSACStepper

ROWS, OBS, ACT = 16, 5, 2


def _make(dtype):
    actor = FlashActor(OBS, ACT, width=8, head="unit").to(dtype)
    critic = EnsembleCritic(OBS, ACT, width=16).to(dtype)
    fill_networks(actor, critic)
    return FlashSACLoss(actor, critic, gamma=0.99).to(dtype)


def _batch(dtype):
    row = torch.arange(ROWS, dtype=torch.float64)
    return TensorDict(
        {
            "observation": observation(ROWS, OBS).to(dtype),
            "action": grid(ROWS, ACT, lambda b, j: torch.sin(1.1 * b + 0.6 * j)).to(
                dtype
            ),
            "next": {
                "observation": observation(ROWS, OBS, 0.4).to(dtype),
                "reward": torch.cos(0.9 * row)[:, None].to(dtype),
                "terminated": (row % 5 == 0)[:, None],
            },
        },
        [ROWS],
    )


def _noise(dtype):
    def noise(function):
        return grid(ROWS, ACT, function).to(dtype)[None]

    return {
        "actor_noise": noise(lambda b, j: 1.5 * torch.sin(2.1 * b + 0.8 * j)),
        "target_noise": noise(lambda b, j: 1.5 * torch.cos(1.7 * b + 0.5 * j)),
    }


def _value(critic, td):
    log_p = critic(td["observation"], td["action"], mode="eval")
    return critic.expected_value(log_p)[0].detach()


@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float64, 1e-7), (torch.float32, 2e-5)], ids=str
)
def test_golden_trace(dtype, tolerance):
    def close(found, wanted):
        wanted = torch.tensor(wanted, dtype=torch.float64)
        torch.testing.assert_close(
            found.detach().double(), wanted, atol=tolerance, rtol=0
        )

    loss, td, noise = _make(dtype), _batch(dtype), _noise(dtype)
    actor, critic = loss.actor_network, loss.qvalue_network
    target = loss.target_qvalue_network
    mean, std = actor(td["observation"], mode="eval")
    close(mean[0, 0], [0.590887371, 0.144203372])
    close(std[0, 0], [3.307805533, 0.015155373])
    close(_value(critic, td)[:, 0], [-0.151063718, 0.016586683])

    stepper = FlashSACStepper(loss)
    reports = [stepper.update(td, **noise) for _ in range(4)]
    actor_losses = torch.stack([r["loss_actor"] for r in reports])
    close(actor_losses[::2], [0.131512656, 0.131074022])
    assert torch.equal(actor_losses[1::2], actor_losses[::2])
    entropies = torch.stack([r["entropy"] for r in reports[::2]])
    close(entropies, [-6.972654905, -6.888117895])
    close(
        torch.stack([r["loss_qvalue"] for r in reports]),
        [5.037813637, 5.016304959, 4.997505242, 4.982784655],
    )
    close(loss.log_alpha[0], -4.604570302)

    embed, last = actor.trunk.embed.norm, actor.trunk.blocks[-1].norm2
    close(embed.running_mean[0, 0], 0.013271574)
    close(last.running_var[0, 0], 0.982128952)
    close(critic.trunk.embed.norm.running_mean[0, [0, 5]], [0.026279043, 0.005879830])
    close(critic.trunk.blocks[-1].norm2.running_var[1, 0], 0.983765994)
    close(target.trunk.embed.norm.running_mean[0, 0], 0.026279043)
    close(target.trunk.blocks[-1].norm2.running_var[1, 0], 0.984526030)
    close(_value(critic, td).mean(-1), [-0.037717087, -0.002252787])
    close(_value(target, td).mean(-1), [-0.038638719, 0.000415228])


def test_target_rows_drift_below_one():
    """Nothing projects the target: 0.999999 after eight updates, as published."""
    loss = _make(torch.float64)
    stepper = FlashSACStepper(loss)
    for _ in range(8):
        stepper.update(_batch(torch.float64), **_noise(torch.float64))
    state = loss.target_qvalue_network.state_dict()
    rows = [state[k].norm(dim=-1) for k in state if "linear" in k or k == "head.weight"]
    norms = torch.cat([row.flatten() for row in rows])
    assert norms.max() < 1
    assert norms.mean().item() == pytest.approx(0.999999, abs=5e-7)


def test_two_groups_with_the_same_task_repeat_the_trace():
    """Own-action critics and equal groups: each group is the golden run by itself."""
    actor = FlashActor(OBS, ACT, num_groups=2, width=8, head="unit").double()
    critic = EnsembleCritic(
        OBS, ACT, num_groups=2, width=16, critic_action="own"
    ).double()
    single, td, noise = (
        _make(torch.float64),
        _batch(torch.float64),
        _noise(torch.float64),
    )
    pair = FlashSACLoss(actor, critic, groups=("left", "right"), gamma=0.99).double()
    with torch.no_grad():
        for name, value in single.actor_network.state_dict().items():
            actor.state_dict()[name].copy_(value)
        for net in (pair.qvalue_network, pair.target_qvalue_network):
            _copy_critic(single.qvalue_network, net)
    for key in ("action", ("next", "reward")):
        for group in ("left", "right"):
            path = ("next", group, "reward") if key != "action" else (group, "action")
            td.set(path, td[key])
    noise = {k: v.expand(2, -1, -1) for k, v in noise.items()}
    report = FlashSACStepper(pair).update(td, **noise)
    for group in ("left", "right"):
        assert report[group, "loss_actor"].item() == pytest.approx(
            0.131512656, abs=1e-7
        )
        assert report[group, "loss_qvalue"].item() == pytest.approx(
            5.037813637, abs=1e-7
        )


def _copy_critic(source, target):
    """Copy a one-group critic into both groups; the other group's columns stay zero."""
    columns = OBS + ACT
    for (name, value), old in zip(
        target.state_dict().items(), source.state_dict().values(), strict=True
    ):
        if name == "head_bias" or value.shape[-1] == old.shape[-1]:
            value.copy_(old.repeat(2, *[1] * (old.dim() - 1)))
            continue
        for member in range(4):
            first = OBS + ACT * (member // 2)
            value[member, ..., :OBS] = old[member % 2, ..., :OBS]
            value[member, ..., first : first + ACT] = old[member % 2, ..., OBS:columns]

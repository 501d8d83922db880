"""The learner on a stock TorchRL environment: it knows nothing of hands or motions."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import PendulumEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from flashdex.modules.actor import FlashActor
from flashdex.modules.critic import EnsembleCritic
from flashdex.modules.policy import FlashPolicy
from flashdex.objectives.flashsac import FlashSACLoss
from flashdex.objectives.reward_normalizer import RewardNormalizer
from flashdex.objectives.stepper import FlashSACStepper

NUM_ENVS, HORIZON, MAX_TORQUE = 16, 100, 2.0


def _observe(td):
    angle, speed = td["th"], td["thdot"]
    return td.set("observation", torch.stack([angle.sin(), angle.cos(), speed], -1))


def _step(env, policy, td):
    """One step of all pendulums; the policy acts in [-1, 1], the pendulum in N m."""
    unit = policy(td)["action"]
    td = env.step(td.set("action", MAX_TORQUE * unit))
    _observe(td["next"])
    row = TensorDict(
        {
            "observation": td["observation"],
            "action": unit,
            "next": td["next"].select("observation", "reward", "terminated"),
        },
        td.batch_size,
    )
    return row, step_mdp(td)


def _reset(env):
    params = env.gen_params(batch_size=[NUM_ENVS])
    return _observe(env.reset(params, set_state=False))


def _mean_return(env, policy):
    env.set_seed(7)
    td, total = _reset(env), torch.zeros(NUM_ENVS, 1)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(HORIZON):
            row, td = _step(env, policy, td)
            total += row["next", "reward"]
    return total.mean().item()


def _train(vector_steps, updates_per_step):
    torch.manual_seed(0)
    env = PendulumEnv(seed=0)
    actor = FlashActor(3, 1, width=32, init_std=0.5)
    critic = EnsembleCritic(3, 1, width=32)
    normalizer = RewardNormalizer(NUM_ENVS, gamma=0.97)
    loss = FlashSACLoss(actor, critic, gamma=0.97, reward_normalizer=normalizer)
    stepper = FlashSACStepper(loss, lr=1e-3, lr_end=1e-3)
    policy = FlashPolicy(actor)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20_000), batch_size=128)
    first = _mean_return(env, policy)
    for step in range(vector_steps):
        if step % HORIZON == 0:
            td = _reset(env)
        with set_exploration_type(ExplorationType.RANDOM):
            row, td = _step(env, policy, td)
        ends = torch.full((NUM_ENVS,), step % HORIZON == HORIZON - 1)
        normalizer.update(row["next", "reward"], ends)
        buffer.extend(row)
        if step >= 20:
            for _ in range(updates_per_step):
                report = stepper.update(buffer.sample())
    return first, _mean_return(env, policy), report


def test_updates_run_on_a_stock_environment():
    _, last, report = _train(40, 1)
    assert last < 0
    for name, value in report.items():
        assert torch.isfinite(value), name


@pytest.mark.learn
def test_pendulum_is_learnt():
    """Swing-up from any angle: untrained about -540, solved about -120."""
    first, last, _ = _train(500, 6)
    assert last > 0.35 * first, (first, last)

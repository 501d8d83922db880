"""A stock TorchRL collector, replay buffer and loop around FlashSACLoss.

    python examples/02_train_with_torchrl.py [key=value ...]

`flashdex train` does the same with n-step returns, compact rows, a ledger and
certificates. Here every part is TorchRL's, but for the environment, the networks and
the loss.
"""

import sys

import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import flashdex
from flashdex.modules.actor import FlashActor
from flashdex.modules.critic import EnsembleCritic
from flashdex.modules.policy import FlashPolicy
from flashdex.objectives.flashsac import FlashSACLoss
from flashdex.objectives.stepper import FlashSACStepper

HANDS = ("left", "right")
ablation = "~env.transforms.future_window"  # flat observations: no window encoder
overrides = ["env.num_envs=8", ablation, *sys.argv[1:]]
env = flashdex.make_env(flashdex.compose("quickstart", overrides), seed=0)

torch.manual_seed(0)
width = env.observation_spec["observation"].shape[-1]
joints = env.full_action_spec["left", "action"].shape[-1]
actor = FlashActor(width, joints, num_groups=2, width=32)
critic = EnsembleCritic(width, joints, num_groups=2, width=32)
loss = FlashSACLoss(actor, critic, groups=HANDS, gamma=0.98)
stepper = FlashSACStepper(loss, total_updates=100)
policy = FlashPolicy(actor, groups=HANDS)
buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10_000), batch_size=64)
collector = Collector(
    env,
    policy,
    frames_per_batch=64,
    total_frames=320,
    auto_register_policy_transforms=False,
)

for data in collector:
    buffer.extend(data.reshape(-1))
    metrics = stepper.update(buffer.sample())
    losses = {hand: metrics[hand, "loss_qvalue"].item() for hand in HANDS}
    print(f"{len(buffer)} rows, critic's loss {losses}")
collector.shutdown()

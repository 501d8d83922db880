"""FlashSAC of several hands in plain loops: an oracle for the stacked learner.

Written from the equations and not from the package. There is no ensemble axis: every
tower and every critic has its own matrices, and hands, members, rows and atoms are
visited in loops. BatchNorm, Adam, the Gaussian density, the temperature gradient and
the categorical backup are spelled out; only differentiation is torch's. Slow, float64.
"""

from __future__ import annotations

import copy
import math

import torch

ATOMS = [-5 + 0.1 * i for i in range(101)]


class BatchNorm:
    """Momentum 0.01, eps 1e-5; biased batch variance, unbiased running variance."""

    def __init__(self, gamma, beta, mean, var):
        self.gamma, self.beta, self.mean, self.var = gamma, beta, mean, var

    def __call__(self, x, train):
        mean, var = self.mean, self.var
        if train:
            rows = x.shape[0]
            mean = x.sum(0) / rows
            var = ((x - mean) ** 2).sum(0) / rows
            self.mean = 0.99 * self.mean + 0.01 * mean.detach()
            self.var = 0.99 * self.var + 0.01 * var.detach() * rows / (rows - 1)
        return self.gamma * (x - mean) / torch.sqrt(var + 1e-5) + self.beta

    def project(self):
        joint = (self.gamma**2).sum() + (self.beta**2).sum()
        scale = torch.sqrt(len(self.gamma) / (joint + 1e-8))
        self.gamma.data *= scale
        self.beta.data *= scale


class Network:
    """BN, embed, residual blocks of two layers, RMSNorm, output matrix with bias."""

    def __init__(self, norms, weights, rms, head, bias, *, unit_head):
        self.norms, self.weights, self.rms = norms, weights, rms
        self.head, self.bias, self.unit_head = head, bias, unit_head

    def __call__(self, x, train):
        x = self.norms[0](x, train) @ self.weights[0].T
        for i in range(1, len(self.weights), 2):
            y = torch.relu(self.norms[i](x @ self.weights[i].T, train))
            y = torch.relu(self.norms[i + 1](y @ self.weights[i + 1].T, train))
            x = x + y
        x = self.rms * x / torch.sqrt((x**2).sum(1, keepdim=True) / x.shape[1] + 1e-6)
        return x @ self.head.T + self.bias

    def parameters(self):
        affine = [p for norm in self.norms for p in (norm.gamma, norm.beta)]
        return [*affine, *self.weights, self.rms, self.head, self.bias]

    def tensors(self):
        statistics = [s for norm in self.norms for s in (norm.mean, norm.var)]
        return [*self.parameters(), *statistics]

    def project(self):
        for norm in self.norms:
            norm.project()
        matrices = [*self.weights, *([self.head] if self.unit_head else [])]
        for matrix in matrices:
            for row in matrix.data:
                row /= (row**2).sum().sqrt()
        self.rms.data *= torch.sqrt(len(self.rms) / ((self.rms**2).sum() + 1e-8))


class Encoder:
    """Three temporal convolutions with SiLU, then a linear map of the flat frames."""

    def __init__(self, kernels, biases, matrix, offset):
        self.kernels, self.biases = kernels, biases
        self.matrix, self.offset = matrix, offset

    def __call__(self, x):
        for kernel, bias, stride in zip(
            self.kernels, self.biases, (1, 2, 1), strict=True
        ):
            x = torch.nn.functional.conv1d(x, kernel, bias, stride)
            x = x * torch.sigmoid(x)
        return x.mT.flatten(1) @ self.matrix.T + self.offset

    def parameters(self):
        return [*self.kernels, *self.biases, self.matrix, self.offset]

    tensors = parameters


class Adam:
    """Betas .9 and .999, eps 1e-8."""

    def __init__(self, parameters, lr):
        self.parameters, self.lr, self.steps = parameters, lr, 0
        self.first = [torch.zeros_like(p) for p in parameters]
        self.second = [torch.zeros_like(p) for p in parameters]

    def step(self, grads):
        self.steps += 1
        for i, grad in enumerate(grads):
            self.first[i] = 0.9 * self.first[i] + 0.1 * grad
            self.second[i] = 0.999 * self.second[i] + 0.001 * grad**2
            mean = self.first[i] / (1 - 0.9**self.steps)
            square = self.second[i] / (1 - 0.999**self.steps)
            self.parameters[i].data -= self.lr * mean / (torch.sqrt(square) + 1e-8)


class PerHandFlashSAC:
    """The update for H hands with joint-action twin critics.

    Args:
        actors: a network a hand, and encoders a hand (or None).
        critics: ``critics[hand][member]``, and one shared encoder (or None).
        log_alpha: list of H tensors ().
        log_std: lower and upper end of the log-std.
        target_entropy: of one hand.
        gate: a hand's actor loss sees the other hands' actions as constants.
    """

    def __init__(
        self, actors, critics, log_alpha, *, log_std, target_entropy, gate=True, lr=3e-4
    ):
        self.actors, self.actor_encoders = actors
        self.critics, self.critic_encoder = critics
        self.targets, self.target_encoder = copy.deepcopy(critics)
        self.log_alpha, self.log_std, self.gate = log_alpha, log_std, gate
        self.target_entropy, self.updates = target_entropy, 0
        self.hands = range(len(self.actors))
        encoders = [e for e in self.actor_encoders if e is not None]
        nets = [*self.actors, *encoders]
        self.actor_adam = Adam([p for n in nets for p in n.parameters()], lr)
        self.alpha_adam = Adam(log_alpha, lr)
        self.critic_adam = Adam(self._parameters(self.critics, self.critic_encoder), lr)

    @staticmethod
    def _parameters(critics, encoder):
        nets = [net for pair in critics for net in pair]
        nets += [] if encoder is None else [encoder]
        return [p for n in nets for p in n.parameters()]

    def _policy(self, hand, state, window, train):
        encoder = self.actor_encoders[hand]
        if encoder is not None:
            state = torch.cat([state, encoder(window)], 1)
        mean, raw = self.actors[hand](state, train).chunk(2, 1)
        low, high = self.log_std
        return mean, torch.exp(low + (high - low) * (1 + torch.tanh(raw)) / 2)

    @staticmethod
    def _sample(mean, std, eps):
        u = mean + std * eps
        normal = -(((u - mean) / std) ** 2) / 2 - std.log() - math.log(2 * math.pi) / 2
        # log(1 - tanh^2) = -2 log cosh
        return torch.tanh(u), (normal + 2 * torch.log(torch.cosh(u))).sum(1)

    @staticmethod
    def _critic_input(encoder, state, window, actions):
        latent = [] if encoder is None else [encoder(window)]
        return torch.cat([state, *latent, *actions], 1)

    @classmethod
    def _both_halves(cls, encoder, batch, after):
        """Replayed rows above those of s' with new actions, as one batch."""
        now = batch["state"], batch["window"], batch["action"]
        then = batch["next_state"], batch["next_window"], [a for a, _ in after]
        return torch.cat([cls._critic_input(encoder, *half) for half in (now, then)])

    def update(self, batch, actor_noise, target_noise):
        """One update; noises (H, B, A). Returns per-hand losses of this update."""
        report = {}
        if self.updates % 2 == 0:
            report = self._actor_step(batch, actor_noise)
        report["loss_qvalue"] = self._critic_step(batch, target_noise)
        new = self._parameters(self.critics, self.critic_encoder)
        old = self._parameters(self.targets, self.target_encoder)
        for target, online in zip(old, new, strict=True):
            target.data += 0.01 * (online.data - target.data)
        self.updates += 1
        return report

    def _actor_step(self, batch, noise):
        size, atoms = len(batch["state"]), torch.tensor(ATOMS, dtype=torch.float64)
        both = torch.cat([batch["state"], batch["next_state"]])
        windows = batch["window"], batch["next_window"]
        windows = None if windows[0] is None else torch.cat(windows)
        samples, alphas = [], [value.exp().item() for value in self.log_alpha]
        for h in self.hands:
            mean, std = self._policy(h, both, windows, True)
            samples.append(self._sample(mean[:size], std[:size], noise[h]))
        losses, entropies = [], []
        for h in self.hands:
            actions = [
                samples[g][0].detach() if self.gate and g != h else samples[g][0]
                for g in self.hands
            ]
            x = self._critic_input(
                self.critic_encoder, batch["state"], batch["window"], actions
            )
            first, second = (
                torch.softmax(c(x, False), 1) @ atoms for c in self.critics[h]
            )
            cost = alphas[h] * samples[h][1] - torch.minimum(first, second)
            losses.append(cost[batch["valid"][h]].mean())
            entropies.append(-samples[h][1][batch["valid"][h]].mean().detach())
        self.actor_adam.step(
            torch.autograd.grad(sum(losses), self.actor_adam.parameters)
        )
        for actor in self.actors:
            actor.project()
        # d/d log_alpha of alpha (H - H_target)
        self.alpha_adam.step(
            [alphas[h] * (entropies[h] - self.target_entropy) for h in self.hands]
        )
        return {"loss_actor": [x.item() for x in losses], "entropy": entropies}

    def _critic_step(self, batch, noise):
        size = len(batch["state"])
        with torch.no_grad():
            after = [
                self._sample(
                    *self._policy(h, batch["next_state"], batch["next_window"], False),
                    noise[h],
                )
                for h in self.hands
            ]
        losses = []
        inputs = self._both_halves(self.critic_encoder, batch, after)
        target_inputs = self._both_halves(self.target_encoder, batch, after)
        for h in self.hands:
            with torch.no_grad():
                probs = [
                    torch.softmax(c(target_inputs, True), 1)[size:].tolist()
                    for c in self.targets[h]
                ]
            cost = self.log_alpha[h].exp().item() * after[h][1]
            target = [
                self._backup(batch, h, b, [p[b] for p in probs], cost[b].item())
                for b in range(size)
            ]
            for critic in self.critics[h]:
                log_p = torch.log_softmax(critic(inputs, True), 1)[:size]
                cross = -(torch.tensor(target, dtype=torch.float64) * log_p).sum(1)
                losses.append(cross[batch["valid"][h]].mean())
        loss = sum(losses) / len(losses)
        self.critic_adam.step(torch.autograd.grad(loss, self.critic_adam.parameters))
        for pair in self.critics:
            for critic in pair:
                critic.project()
        return [(losses[2 * h] + losses[2 * h + 1]).item() / 2 for h in self.hands]

    @staticmethod
    def _backup(batch, hand, row, members, entropy_cost):
        """Distribution on the atoms of one row: the least member, moved and split."""
        values = [sum(z * p for z, p in zip(ATOMS, m, strict=True)) for m in members]
        least = members[0] if values[0] <= values[1] else members[1]
        carry = batch["discount"][row] * (1 - batch["terminated"][row].item())
        result = [0.0] * len(ATOMS)
        for z, p in zip(ATOMS, least, strict=True):
            moved = batch["reward"][hand][row].item() + carry * (z - entropy_cost)
            place = (min(max(moved, -5.0), 5.0) + 5.0) / 0.1
            lower = min(int(place), len(ATOMS) - 2)
            result[lower] += p * (lower + 1 - place)
            result[lower + 1] += p * (place - lower)
        return result

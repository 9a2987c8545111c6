"""Train with TorchRL's PPO on objects, rows of numbers.

    python examples/torchrl_ppo.py 200000

TorchRL's wrapper takes the batched environment as it is, also that of self-play. Needs `pip install -e ".[torchrl]"`.
"""

import sys
from collections.abc import Iterator

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper
from torchrl.modules import MLP, OneHotCategorical, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import negopipe

OVERRIDES = ("+experiment=yield", "observation=objects", "policy=objects")
N_EPOCHS, N_PARTS, RATE, LARGEST_GRADIENT = 5, 16, 1e-3, 0.5


def main(n_decisions: int, n_worlds: int = 64, n_steps: int = 128, overrides: tuple[str, ...] = ()) -> Iterator[float]:
    """Train for some decisions; yields the share of successes among the episodes that ended, batch by batch."""
    torch.manual_seed(1)
    envs = GymWrapper(negopipe.make_vec_env(n_worlds, [*OVERRIDES, *overrides]))
    envs.set_seed(1)
    size, n_actions = envs.observation_spec["observation"].shape[-1], envs.action_spec.shape[-1]
    shape = {"in_features": size, "num_cells": [128, 128], "activation_class": nn.Tanh}
    choice = TensorDictModule(MLP(out_features=n_actions, **shape), ["observation"], ["logits"])
    actor = ProbabilisticActor(choice, ["logits"], distribution_class=OneHotCategorical, return_log_prob=True)
    critic = ValueOperator(MLP(out_features=1, **shape))
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.01)
    optimizer = torch.optim.Adam(loss.parameters(), lr=RATE)
    collected = {"frames_per_batch": n_worlds * n_steps, "total_frames": n_decisions}
    for batch in Collector(envs, actor, **collected, auto_register_policy_transforms=False):
        for _ in range(N_EPOCHS):
            flat = advantage(batch).reshape(-1)
            for index in torch.randperm(len(flat)).chunk(N_PARTS):
                told = loss(flat[index])
                (told["loss_objective"] + told["loss_critic"] + told["loss_entropy"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), LARGEST_GRADIENT)
                optimizer.step()
                optimizer.zero_grad()
        paid_at_end = batch["next", "reward"][batch["next", "done"]]
        yield int((paid_at_end > 0).sum()) / max(1, len(paid_at_end))  # a success alone is paid more than nothing


if __name__ == "__main__":
    torch.set_num_threads(1)
    for share in main(int(sys.argv[1])):
        print(f"success {share:.0%}", flush=True)

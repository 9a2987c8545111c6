"""PPO on one page, in the manner of CleanRL: torch and one vector environment, nothing else.

python examples/single_file_ppo.py 50000
"""

import sys

import torch
from torch import nn
from torch.distributions import Categorical

import negopipe

GAMMA, LAMBDA, CLIP, ENTROPY, RATE, N_EPOCHS = 0.99, 0.95, 0.2, 0.01, 3e-4, 4


def main(n_decisions: int, n_worlds: int = 16, n_steps: int = 64) -> list[float]:
    """Train for some decisions; returns the mean reward per decision of each iteration."""
    torch.manual_seed(1)
    envs = negopipe.make_vec_env(n_worlds, ["+experiment=yield", "observation=objects", "policy=objects"])
    n_inputs, n_actions = envs.single_observation_space.shape[0], int(envs.single_action_space.n)  # type: ignore
    network = nn.Sequential(nn.Linear(n_inputs, 128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh())
    actor, critic = nn.Linear(128, n_actions), nn.Linear(128, 1)
    optimizer = torch.optim.Adam(nn.ModuleList([network, actor, critic]).parameters(), lr=RATE)
    seen, paid = torch.from_numpy(envs.reset(seed=1)[0]), []
    for _ in range(max(1, n_decisions // (n_worlds * n_steps))):
        rows = []
        with torch.no_grad():
            for _ in range(n_steps):
                features = network(seen)
                choice = Categorical(logits=actor(features))
                action = choice.sample()
                after, reward, terminated, truncated, _ = envs.step(action.numpy())
                gain, over = torch.from_numpy(reward).float(), torch.from_numpy(terminated | truncated).float()
                rows.append((seen, action, choice.log_prob(action), critic(features)[:, 0], gain, over))
                seen = torch.from_numpy(after)
            value, advantage, advantages = critic(network(seen))[:, 0], torch.zeros(n_worlds), []
            for _, _, _, before, gain, over in reversed(rows):
                delta = gain + GAMMA * value * (1 - over) - before
                advantage, value = delta + GAMMA * LAMBDA * (1 - over) * advantage, before
                advantages.append(advantage)
        obs, action, old, before, gain, _ = (torch.cat(column) for column in zip(*rows, strict=True))
        gae = torch.cat(advantages[::-1])
        target, gae = gae + before, (gae - gae.mean()) / (gae.std() + 1e-8)
        for index in (part for _ in range(N_EPOCHS) for part in torch.randperm(len(obs)).chunk(4)):
            features = network(obs[index])
            choice = Categorical(logits=actor(features))
            ratio = (choice.log_prob(action[index]) - old[index]).exp()
            gains = torch.minimum(ratio * gae[index], ratio.clamp(1 - CLIP, 1 + CLIP) * gae[index])
            error = (critic(features)[:, 0] - target[index]).square().mean()
            loss = 0.5 * error - gains.mean() - ENTROPY * choice.entropy().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        paid.append(float(gain.mean()))
    return paid


if __name__ == "__main__":
    print(" ".join(f"{reward:.3f}" for reward in main(int(sys.argv[1]))))

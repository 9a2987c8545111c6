"""The teacher of a training: a trained policy that sees the same worlds with its own observation."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from negopipe.agents.horizon_drivers import in_batches
from negopipe.errors import UserError
from negopipe.game.environment import NegotiationEnv
from negopipe.game.game import Game
from negopipe.observation.kinds import build_observation
from negopipe.runtime.build import load_described
from negopipe.tensors.tree import map_tensors

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig


class Teacher:
    """What the trained policy of `curriculum.teacher` would do in the present state of an environment.

    Called, it returns probabilities [A, n_actions], zeros for agents that another driver drives; see
    `negopipe.learning.teacher.Advice`.

    UserError where it has other horizons than the policy in training, or remembers more than the game shows.
    """

    def __init__(self, config: "RunConfig", game: Game, env: NegotiationEnv, checkpoint: str) -> None:
        policy, network, observation = load_described(checkpoint, config)
        key = "curriculum.teacher.checkpoint"
        if network.horizons_s != config.policy.horizons_s:
            allowed, got = list(config.policy.horizons_s), list(network.horizons_s)
            raise UserError(f"{key} must choose among policy.horizons_s = {allowed}, got {checkpoint} with {got}")
        dt_s = config.scenario.dt_s
        needed, shown = (each.history_steps(dt_s) * dt_s for each in (observation, config.observation))
        if needed > shown + dt_s / 2:
            rule = f"remember at most {shown:g} s, as observation.n_frames and observation.frame_interval_s do"
            raise UserError(f"{key} must {rule}, got {checkpoint} with {needed:g} s")
        device = game.planner.times.device
        self._env = env
        self._logits = in_batches(policy.to(device), device)
        self._see = game.watch(build_observation(observation, game.simulator))

    @torch.no_grad()
    def __call__(self) -> Tensor:
        world, is_learning = self._env.world, self._env.is_learning()
        agent = is_learning.nonzero()[:, 0]
        vehicle, row = agent // self._env.n_worlds, agent % self._env.n_worlds
        part = map_tensors(lambda field: field.index_select(0, row), world)
        probs = self._logits(self._see(part, vehicle)).softmax(-1)
        return probs.new_zeros(len(is_learning), probs.shape[1]).index_copy(0, agent, probs)

"""The league: earlier states of a policy that is being trained, as drivers of social vehicles.

A policy that meets itself only as it is forgets how to deal with what it was before (Vinyals et al. 2019).
"""

from copy import deepcopy

import torch
from torch import Tensor

from negopipe.agents.population import Cast, LeagueDriver
from negopipe.policy.actor_critic import ActorCritic
from negopipe.simulation.state import Task
from negopipe.tensors.prefixes import add_prefix, strip_prefix
from negopipe.training.lost_shares import LostShares


class League:
    """The members of the leagues of a cast.

    members: by index in the cast, policies that do not learn; the present policy at first
    lost: shares of the episodes with each driver of the cast that were not won
    hard_share: share of the draws that follow these, for all drivers
    """

    def __init__(self, cast: Cast, policy: ActorCritic, hard_share: float = 0.0) -> None:
        drivers = {index: each for index, each in cast.learned.items() if isinstance(each, LeagueDriver)}
        self.members = {index: deepcopy(policy).requires_grad_(False) for index in drivers}
        self.lost = LostShares(len(cast.names), cast.weights.device)
        self._cast, self._hard_share = cast, hard_share
        self._leagues: dict[str, tuple[LeagueDriver, list[int]]] = {}
        for index, driver in drivers.items():
            name = cast.names[index].rpartition("_")[0]
            self._leagues.setdefault(name, (driver, []))[1].append(index)

    def assign(self, task: Task) -> Task:
        """As `Cast.assign`, with the drivers' shares of now."""
        weights = self.lost.weigh(self._cast.weights, self._hard_share)
        for driver, indices in self._leagues.values():
            if driver.draw == "hardest":
                only = torch.zeros_like(weights).index_copy_(0, weights.new_tensor(indices).long(), weights[indices])
                weights[indices] = self.lost.weigh(only, 1.0)[indices]
        return self._cast.weighted(weights).assign(task)

    def admit(self, policy: ActorCritic, n_done: int) -> None:
        """Let the policy as it is after `n_done` iterations take the oldest member's place, where one is due."""
        for driver, indices in self._leagues.values():
            n_admitted, rest = divmod(n_done, driver.every_iterations)
            if rest == 0 and n_admitted > 0:
                index = indices[(n_admitted - 1) % len(indices)]
                self.members[index].load_state_dict(policy.state_dict())
                self.lost.shares[index] = 1.0

    def state_dict(self) -> dict[str, Tensor]:
        """State on which the next iteration depends."""
        weights = (add_prefix(str(index), member.state_dict()) for index, member in self.members.items())
        return {name: tensor for each in weights for name, tensor in each.items()} | {"lost": self.lost.shares}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        for index, member in self.members.items():
            member.load_state_dict(strip_prefix(str(index), state))
        self.lost.shares = state["lost"].to(self.lost.shares.device)

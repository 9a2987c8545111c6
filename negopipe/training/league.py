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

DECAY = 0.99
"""Weight of the earlier episodes in a member's share of lost ones, at every new episode."""
LEAST_LOST = 0.05
"""Share of lost episodes with which a member counts at least, so that none is forgotten."""


class League:
    """The members of the leagues of a cast.

    members: by index in the cast, policies that do not learn; the present policy at first
    lost: [K] float64, by index in the cast, share of the episodes with each driver that were not won; 1 at first
    """

    def __init__(self, cast: Cast, policy: ActorCritic) -> None:
        drivers = {index: each for index, each in cast.learned.items() if isinstance(each, LeagueDriver)}
        self.members = {index: deepcopy(policy).requires_grad_(False) for index in drivers}
        self.lost = torch.ones_like(cast.weights)
        self._cast = cast
        self._leagues: dict[str, tuple[LeagueDriver, list[int]]] = {}
        for index, driver in drivers.items():
            name = cast.names[index].rpartition("_")[0]
            self._leagues.setdefault(name, (driver, []))[1].append(index)

    def assign(self, task: Task) -> Task:
        """As `Cast.assign`, with the members' shares of now."""
        weights = self._cast.weights.clone()
        for driver, indices in self._leagues.values():
            if driver.draw == "hardest":
                lost = self.lost[indices].clamp(min=LEAST_LOST)
                weights[indices] = weights[indices].sum() * lost / lost.sum()
        return self._cast.weighted(weights).assign(task)

    def record(self, driver: Tensor, is_success: Tensor) -> None:
        """Count episodes that are over; driver: [N], index in the cast; is_success: [N] bool."""
        for index in self.members:
            is_its = driver == index
            n = int(is_its.sum())
            if n > 0:
                new = 1 - is_success[is_its].double().mean()
                self.lost[index] = new + DECAY**n * (self.lost[index] - new)

    def admit(self, policy: ActorCritic, n_done: int) -> None:
        """Let the policy as it is after `n_done` iterations take the oldest member's place, where one is due."""
        for driver, indices in self._leagues.values():
            n_admitted, rest = divmod(n_done, driver.every_iterations)
            if rest == 0 and n_admitted > 0:
                index = indices[(n_admitted - 1) % len(indices)]
                self.members[index].load_state_dict(policy.state_dict())
                self.lost[index] = 1.0

    def state_dict(self) -> dict[str, Tensor]:
        """State on which the next iteration depends."""
        if not self.members:
            return {}
        weights = (add_prefix(str(index), member.state_dict()) for index, member in self.members.items())
        return {name: tensor for each in weights for name, tensor in each.items()} | {"lost": self.lost}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        for index, member in self.members.items():
            member.load_state_dict(strip_prefix(str(index), state))
        if self.members:
            self.lost = state["lost"].to(self.lost.device)

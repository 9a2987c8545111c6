"""Rollouts of a policy in an environment, and the interface of an environment.

Axes: T steps of the rollout, E worlds, A agents, of which the first E are the egos of the worlds. A world may hold
further agents that the policy drives, as in self-play. `*obs` is the shape of one observation.
"""

from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol

import torch
from torch import Generator, Tensor

from negopipe.learning.teacher import Advice
from negopipe.policy.actor_critic import ActorCritic, log_prob_of, sample_action
from negopipe.tensors.share import WHOLE, Share

OF_WORLDS = ("episode_return", "episode_steps", "is_success", "is_collision")
"""Fields of a rollout that are numbers of worlds, not of agents."""
NOT_JOINED = ("observation", "final_info", "advice", "share")
"""Fields of a rollout that are not numbers of agents or worlds."""


@dataclass(frozen=True)
class Transition:
    """One decision of every agent.

    observation: [A, *obs], next observation; where the episode is over, the first one of the next episode
    final_observation: [D, *obs] of the states reached by the D agents whose episode is over, in their order
    reward: [A] float32
    is_terminated: [A] bool, the episode is over: every vehicle has arrived, or a collision
    is_truncated: [A] bool, the episode was cut off, as at the time limit; the state reached has a value
    is_success, is_collision: [E] bool, outcome of the episode; meaningful only where the ego's is over
    final_info: name -> [D], further facts of the egos' episodes that are over, for the record only
    """

    observation: Tensor
    final_observation: Tensor
    reward: Tensor
    is_terminated: Tensor
    is_truncated: Tensor
    is_success: Tensor
    is_collision: Tensor
    final_info: dict[str, Tensor] = field(default_factory=dict)

    @property
    def is_done(self) -> Tensor:
        """[A] bool: the episode is over."""
        return self.is_terminated | self.is_truncated


class Environment(Protocol):
    """E worlds that step together; where an episode is over, the next one starts at once."""

    n_worlds: int

    def observe(self) -> Tensor:
        """Present observations, [A, *obs]."""
        ...

    def is_learning(self) -> Tensor:
        """[A] bool: the policy drives the agent, so its decision is one to learn from; true of every ego."""
        ...

    def step(self, action: Tensor) -> Transition:
        """Carry out the actions [A] int64; those of agents that another driver drives mean nothing."""
        ...


@dataclass(frozen=True)
class Rollout:
    """T decisions of A agents, on the environment's device.

    observation: [T, A, *obs] in the environment's dtype, s_t
    is_learning: [T, A] bool, a decision of the policy; what is said of others means nothing
    action: [T, A] int64, a_t
    log_prob: [T, A] float32, log pi(a_t|s_t)
    reward, value: [T, A] float32, r_t and V(s_t)
    is_terminated, is_truncated: [T, A] bool
    final_value: [T, A] float32, value of the final observation where truncated, else 0
    last_value: [A] float32, V(s_T)
    episode_return: [T, E] float32, undiscounted return of the ego's episode that ended with step t; NaN where none did
    episode_steps: [T, E] int64, its number of decisions; 0 where none ended
    is_success, is_collision: [T, E] bool, its outcome; false where none ended
    final_info: name -> [N], `Transition.final_info` of the N episodes that ended, in the order of `is_over`
    advice: [T, A, n_actions] float32, a teacher's probabilities of the actions in s_t; None = there is no teacher
    share: this rank's among the agents of all ranks, whose numbers these are; observation and advice are of its own
    """

    observation: Tensor
    is_learning: Tensor
    action: Tensor
    log_prob: Tensor
    reward: Tensor
    value: Tensor
    is_terminated: Tensor
    is_truncated: Tensor
    final_value: Tensor
    last_value: Tensor
    episode_return: Tensor
    episode_steps: Tensor
    is_success: Tensor
    is_collision: Tensor
    final_info: dict[str, Tensor] = field(default_factory=dict)
    advice: Tensor | None = None
    share: Share = WHOLE

    @property
    def is_done(self) -> Tensor:
        """[T, A] bool: an agent's episode ended with step t."""
        return self.is_terminated | self.is_truncated

    @property
    def is_over(self) -> Tensor:
        """[T, E] bool: a world's episode ended with step t."""
        return self.is_done[:, : self.episode_return.shape[1]]


@dataclass(frozen=True)
class RunningEpisodes:
    """The episodes that a rollout leaves unfinished: return [E] float32 and number of decisions [E] int64 so far."""

    reward_sum: Tensor
    n_steps: Tensor

    @classmethod
    def start(cls, n_worlds: int, device: torch.device) -> "RunningEpisodes":
        """Episodes that are about to start in E worlds."""
        return cls(torch.zeros(n_worlds, device=device), torch.zeros(n_worlds, dtype=torch.int64, device=device))


@torch.no_grad()
def collect(
    env: Environment,
    policy: ActorCritic,
    n_steps: int,
    generator: Generator,
    running: RunningEpisodes,
    teacher: Advice | None = None,
    worlds: Share = WHOLE,
) -> tuple[Rollout, RunningEpisodes]:
    """Roll `policy` out for `n_steps` decisions, sampling its actions; collective.

    generator: draws the actions; on the environment's device
    running: the unfinished episodes of the worlds, as the previous call returned them
    teacher: asked in every state of the environment; the policy's own actions are carried out
    worlds: this rank's share in the worlds of all ranks
    """
    observation = env.observe()
    agents = worlds.repeated(len(observation) // env.n_worlds)
    observations = observation.new_empty(n_steps, *observation.shape)
    steps: list[dict[str, Tensor]] = []
    infos: list[dict[str, Tensor]] = []
    advice: list[Tensor] = []
    for t in range(n_steps):
        observations[t], is_learning = observation, env.is_learning()
        logits, value = _run(policy, observation, is_learning)
        action = agents.own(sample_action(agents.spread(logits), generator))
        if teacher is not None:
            advice.append(teacher())
        transition = env.step(action)
        running, ended = _count(running, transition)
        decided = {"is_learning": is_learning, "action": action, "value": value}
        decided["log_prob"] = log_prob_of(action, logits.log_softmax(-1))
        steps.append({**decided, **_outcome(policy, transition, is_learning), **ended})
        infos.append(transition.final_info)
        observation = transition.observation
    last_value = _run(policy, observation, env.is_learning())[1]
    stacked = {name: torch.stack([step[name] for step in steps]) for name in steps[0]}
    own = Rollout(
        observation=observations,
        **stacked,  # type: ignore[arg-type]  # of fields that are tensors
        last_value=last_value,
        final_info={name: torch.cat([info[name] for info in infos]) for name in infos[0]},
        advice=torch.stack(advice) if advice else None,
        share=agents,
    )
    return _joined(own, worlds), running


def _run(policy: ActorCritic, observation: Tensor, is_learning: Tensor) -> tuple[Tensor, Tensor]:
    """Logits [A, n_actions] and values [A] for observations [A, *obs]; 0 for those that the policy does not drive."""
    if is_learning.all():
        return policy(observation)
    index = is_learning.nonzero()[:, 0]
    outputs = policy(observation[index])
    logits, value = (each.new_zeros(len(observation), *each.shape[1:]).index_copy(0, index, each) for each in outputs)
    return logits, value


def _joined(rollout: Rollout, worlds: Share) -> Rollout:
    """The rollout with the numbers of all ranks' agents and worlds, and with the observations of this rank's alone."""
    if worlds.ranks.number == 1:
        return rollout
    is_over = rollout.is_over
    infos = {name: is_over.new_zeros(is_over.shape, dtype=info.dtype) for name, info in rollout.final_info.items()}
    for name, info in rollout.final_info.items():
        infos[name][is_over] = info
    steps = {each.name: getattr(rollout, each.name) for each in fields(rollout) if each.name not in NOT_JOINED}
    steps["last_value"] = steps["last_value"][None]
    by_world = {name: steps.pop(name).T for name in OF_WORLDS} | {name: info.T for name, info in infos.items()}
    by_agent = {name: numbers.T for name, numbers in steps.items()}
    gathered = rollout.share.gather(by_agent) | worlds.gather(by_world)
    joined: dict[str, Any] = {name: numbers.T.contiguous() for name, numbers in gathered.items()}
    joined["last_value"] = joined["last_value"][0]
    ended = {name: joined.pop(name) for name in infos}
    rollout = replace(rollout, **joined)
    return replace(rollout, final_info={name: info[rollout.is_over] for name, info in ended.items()})


def _outcome(policy: ActorCritic, transition: Transition, is_learning: Tensor) -> dict[str, Tensor]:
    """What a transition brings the agents, each [A]."""
    return {
        "reward": transition.reward,
        "is_terminated": transition.is_terminated,
        "is_truncated": transition.is_truncated,
        "final_value": _final_value(policy, transition, is_learning),
    }


def _final_value(policy: ActorCritic, transition: Transition, is_learning: Tensor) -> Tensor:
    """[A] float32: values of the final observations where truncated, else 0; the network is run on those only."""
    final_value = torch.zeros_like(transition.reward)
    is_valued = transition.is_truncated & is_learning
    if is_valued.any():
        final_value[is_valued] = policy(transition.final_observation[is_valued[transition.is_done]])[1]
    return final_value


def _count(running: RunningEpisodes, transition: Transition) -> tuple[RunningEpisodes, dict[str, Tensor]]:
    """The running episodes of the egos after a step, and the results of those that it ended."""
    n_worlds = len(running.n_steps)
    is_done = transition.is_done[:n_worlds]
    reward_sum = running.reward_sum + transition.reward[:n_worlds]
    n_steps = running.n_steps + 1
    ended = {
        "episode_return": torch.where(is_done, reward_sum, torch.nan),
        "episode_steps": torch.where(is_done, n_steps, 0),
        "is_success": is_done & transition.is_success,
        "is_collision": is_done & transition.is_collision,
    }
    return RunningEpisodes(torch.where(is_done, 0.0, reward_sum), torch.where(is_done, 0, n_steps)), ended

"""Training by Algorithm 1, one iteration at a time."""

import logging
import math
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from negopipe.errors import UserError
from negopipe.game.curriculum import Curriculum, CurriculumStageConfig
from negopipe.game.environment import NegotiationEnv
from negopipe.learning.learner import Learner
from negopipe.learning.rollout import Rollout, RunningEpisodes, collect
from negopipe.runtime.build import build, device_of, game_of, load_weights, save_policy, with_learned
from negopipe.simulation.scenario import TaskSampler
from negopipe.tensors.prefixes import add_prefix, strip_prefix
from negopipe.tensors.ranks import ALONE, Ranks
from negopipe.tensors.seeding import generator
from negopipe.tensors.share import share_of
from negopipe.tracking.checkpoint import CHECKPOINT_NAME, find_checkpoint
from negopipe.tracking.run_folder import DEMONSTRATIONS_NAME, HISTORY_NAME, TRAINING_EPISODES_NAME
from negopipe.tracking.snapshots import Snapshots
from negopipe.training.demonstration_search import demonstrations
from negopipe.training.league import League
from negopipe.training.learning_curve import MEANS_OF_EPISODES, LearningCurve
from negopipe.training.lost_shares import LostShares
from negopipe.training.shared_worlds import SharedTasks, joined, own
from negopipe.training.teacher import Teacher

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")


class Training:
    """Algorithm 1, one iteration at a time; its state can be saved and restored between iterations.

    folder: run folder that keeps the demonstrations; None = search for them anew
    ranks: processes that train together; each has a `Training` of its own, and its worlds are a share of all
    n_total, n_done: iterations of all stages together
    is_at_stage_end: whether the latest iteration was the last of its stage
    weights_before: the policy's weights before the latest iteration
    """

    def __init__(self, config: "RunConfig", folder: Path | None = None, ranks: Ranks = ALONE) -> None:
        device, algorithm, self.ranks = device_of(config), config.algorithm, ranks
        self.curve = LearningCurve(algorithm.n_worlds * algorithm.n_steps)  # its clock starts now
        game, self.policy = build(config)
        if config.checkpoint is not None:
            load_weights(find_checkpoint(config.checkpoint, config), self.policy, config)
        demonstrated = demonstrations(config, game, folder, ranks)
        self.learner = Learner(self.policy, algorithm, generator(config.seed, "updates", device), demonstrated)
        tasks, self.actions = (generator(config.seed, purpose, device) for purpose in ("training tasks", "actions"))
        self.n_steps = algorithm.n_steps
        self.curriculum, self._reward = Curriculum(config.curriculum), config.reward
        scenario = config.curriculum.scenario(config.scenario)
        hard_share = config.curriculum.hard_share
        self.league = League(game.cast, self.policy, hard_share)
        self._lost_streets = LostShares(len(scenario.training_streets), device)
        self._hard_share = hard_share
        self._samplers = [
            TaskSampler(scenario, stage.families, tasks, self.league.assign, scenario.training_streets)
            for stage in config.curriculum.stages
        ]
        game = with_learned(game_of(config), config, self.policy, self.league.members)
        horizons_s, learners = config.policy.horizons_s, game.cast.learners
        first, end = ranks.slice_of(algorithm.n_worlds)
        self._worlds = share_of(ranks, algorithm.n_worlds, device)
        self.env = NegotiationEnv(game, config.reward, horizons_s, self._shared(0), end - first, learners)
        teacher = config.curriculum.teacher
        self._teacher = None if teacher is None else Teacher(config, game, self.env, teacher.checkpoint)
        self._taught_until = 0.0 if teacher is None else teacher.until
        self.running = RunningEpisodes.start(end - first, device)
        self.weights_before = _copy(self.policy)
        self.is_at_stage_end = False

    @property
    def n_total(self) -> int:
        return self.curriculum.n_total

    @property
    def n_done(self) -> int:
        return len(self.curve)

    def iterate(self) -> dict:
        """One iteration of Algorithm 1; returns its row of the learning curve; collective."""
        self.weights_before = _copy(self.policy)
        waited_s = self.ranks.seconds
        stage, progress = self._select_task_distribution(), self.n_done / self.n_total
        teacher = self._teacher if progress < self._taught_until else None
        given = (self.n_steps, self.actions, self.running, teacher, self._worlds)
        rollout, self.running = collect(self.env, self.policy, *given)
        metrics = self.learner.update(rollout, progress)  # advantages, then the algorithm's updates
        is_success = rollout.is_success[rollout.is_over]
        self.league.lost.record(rollout.final_info["social_driver"], is_success)
        self._lost_streets.record(rollout.final_info["street"] - 1, is_success)
        self.league.admit(self.policy, self.n_done + 1)
        if self.ranks.number > 1:
            check_alike(self.policy, self.ranks)
            metrics["collectives_s"] = self.ranks.seconds - waited_s
        return self._record(stage, rollout, metrics)

    def _shared(self, index: int) -> TaskSampler | SharedTasks:
        """Source of the tasks of a stage, for the worlds of this rank."""
        return self._samplers[index] if self.ranks.number == 1 else SharedTasks(self._samplers[index], self.ranks)

    def _select_task_distribution(self) -> CurriculumStageConfig:
        """The current stage (K, D), from whose D every new episode draws its task."""
        stage = self.curriculum.stage
        self.env.sampler = self._shared(self.curriculum.index)
        if self._hard_share > 0:
            lost, sampler = self._lost_streets, self._samplers[self.curriculum.index]
            sampler.street_weights = lost.weigh(torch.ones_like(lost.shares), self._hard_share)
        self.env.reward_config = self.curriculum.config.reward(stage, self._reward)
        return stage

    def _record(self, stage: CurriculumStageConfig, rollout: Rollout, metrics: dict[str, float]) -> dict:
        """Add the iteration to the learning curve and count it in its stage; returns its row of the curve."""
        row = self.curve.add(stage.name, rollout, metrics)
        is_over = self.curriculum.finish_iteration(rollout.is_success[rollout.is_over].tolist())
        self.is_at_stage_end = is_over or self.n_done == self.n_total
        return row

    def not_finite(self) -> list[str]:
        """Names of the metrics of the last update and of the weights that are NaN or infinite."""
        measures = [(k, v) for k, v in self.curve.rows[-1].items() if k not in MEANS_OF_EPISODES]
        names = [name for name, value in measures if isinstance(value, float) and not math.isfinite(value)]
        return names + [name for name, weight in self.policy.state_dict().items() if not weight.isfinite().all()]

    def save_to(self, snapshots: Snapshots | None) -> None:
        """Save the state on which the next iteration depends; collective.

        The state is that of one process, so that any number of ranks can resume from it.
        snapshots: None on other ranks than the first, which keeps them
        """
        state = (
            add_prefix("policy", self.policy.state_dict())
            | add_prefix("learner", self.learner.state_dict())
            | joined(self.env.state_dict(), self.running, self._worlds)
            | add_prefix("league", self.league.state_dict())
            | {"lost_streets": self._lost_streets.shares}
            | add_prefix("episodes", self.curve.episodes)
            | {"actions": self.actions.get_state()}
        )
        progress = {"curve": self.curve.state_dict(), "curriculum": self.curriculum.state_dict()}
        if snapshots is not None:
            snapshots.save(self.n_done, state, progress | {"n_ranks": self.ranks.number})

    def resume(self, snapshots: Snapshots | None) -> None:
        """Restore the first rank's newest snapshot, if there is one; collective; snapshots: as for `save_to`."""
        newest = self.ranks.first(lambda: None if snapshots is None else snapshots.newest())
        if newest is None:
            return
        state, progress = newest
        self.policy.load_state_dict(strip_prefix("policy", state))
        self.learner.load_state_dict(strip_prefix("learner", state))
        env, self.running = own(state, self.running, self._worlds)
        self.env.load_state_dict(env)
        self.league.load_state_dict(strip_prefix("league", state))
        self._lost_streets.shares = state["lost_streets"].to(self.env.game.simulator.road.device)
        self.actions.set_state(state["actions"])
        self.curve.load_state_dict(progress["curve"], strip_prefix("episodes", state))
        self.curriculum.load_state_dict(progress["curriculum"])
        log.info(f"train      resuming after iteration {self.n_done} of {self.n_total}")
        if (n := progress["n_ranks"]) != self.ranks.number:
            what = "the same draws, but sums are rounded otherwise"
            log.warning(f"ranks      {self.ranks.number} resume what {n} began: {what}")


def save_stage(config: "RunConfig", run: "TrackedRun", training: Training) -> None:
    """Write the checkpoint, the learning curve and the training episodes at the end of a stage."""
    curve = training.curve
    row = curve.rows[-1]
    curve.write(run.folder)
    for name in (HISTORY_NAME, TRAINING_EPISODES_NAME, DEMONSTRATIONS_NAME):
        if (run.folder / name).is_file():
            run.log_artifact(run.folder / name)
    save_policy(run.folder / CHECKPOINT_NAME, training.policy, config, row["decisions"])
    is_final = training.n_done == training.n_total
    run.log_checkpoint(run.folder / CHECKPOINT_NAME, row["decisions"], curve.scalars(row), is_final)


def check_alike(policy: nn.Module, ranks: Ranks) -> None:
    """UserError unless all ranks hold the same weights; collective."""
    bits = [weight.detach().flatten().view(torch.int32).sum(dtype=torch.int64) for weight in policy.parameters()]
    if len(set(ranks.each(int(torch.stack(bits).sum())))) > 1:
        rule = "compute alike, on processors of one kind with the same libraries"
        raise UserError(f"all {ranks.number} ranks must {rule}, got weights that differ between them")


def _copy(policy: nn.Module) -> dict[str, Tensor]:
    """Copies of the weights, by name."""
    return {name: weight.clone() for name, weight in policy.state_dict().items()}

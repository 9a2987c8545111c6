"""The preview stage: a film of what a policy has to learn, within the first minute of a long run."""

import logging
from typing import TYPE_CHECKING

from negopipe.agents.driver import fixed_horizon
from negopipe.agents.horizon_drivers import by_horizon
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.evaluation.names import fixed_name, horizon_in_words
from negopipe.game.game import build_game
from negopipe.report import animation
from negopipe.report.scene import scene_of
from negopipe.runtime.build import with_learned
from negopipe.tensors.torch_settings import one_thread
from negopipe.tensors.tree import map_tensors
from negopipe.tracking.whole_file import write_whole

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")

PREVIEW_NAME = "preview.gif"


@one_thread()
def run(config: "RunConfig", tracked: "TrackedRun") -> None:
    """Film the first task of `evaluation.leading_setting` under the policy's shortest and longest horizon.

    Writes preview.gif into the run folder. Nothing is compiled, since that takes longer than the film.
    """
    setting, paid = config.evaluation.leading_setting, config.evaluation.reward
    game = with_learned(build_game(config, config.device), config, None)
    task = map_tensors(lambda field: field[:1], held_out_tasks(config, game, setting))
    ends = {fixed_name(each): each for each in (min(config.policy.horizons_s), max(config.policy.horizons_s))}
    traces = [
        drive_episodes(game, by_horizon(game, fixed_horizon(horizon_s)), task, 1, paid, (name, setting))
        for name, horizon_s in ends.items()
    ]
    scene = scene_of(game.simulator.road, int(traces[0].street[0]), config.planner.horizon_s)
    path = tracked.folder / PREVIEW_NAME
    write_whole(path, animation.animate(traces, 0, scene, config.report.animation_fps, ends))
    tracked.log_artifact(path)
    log.info(f"preview    {path}: {setting} with horizons of {' and '.join(map(horizon_in_words, ends.values()))}")

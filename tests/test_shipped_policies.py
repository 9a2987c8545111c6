"""The policies that come with negopipe drive as well as the README says they do."""

import pytest
import torch
from composed import compose_config

from negopipe.evaluation.held_out import held_out_tasks
from negopipe.runtime.build import build, load_weights
from negopipe.stages.evaluate import jobs_of
from negopipe.tracking.checkpoint import find_checkpoint

AT_LEAST = {
    "yield": {"push": 0.995, "yield": 0.995},
    "mixture": {"mixture": 0.97},
    "generalist": {"mixture": 0.87},
    "generalist_grids": {"mixture": 0.8},
}
"""Success rates, by policy and setting."""
FEW, MANY, MANY_DRAWN = 12, 1000, 200
"""Tasks; of policies that draw their horizons, whose vehicles and streets are many, fewer."""
COLLISIONS_AT_MOST = {"yield": 0.002, "mixture": 0.005, "generalist": 0.03, "generalist_grids": 0.05}
DRAWN = {"generalist", "generalist_grids"}
"""Those that draw their horizons, on many streets."""


EASY = (
    *("scenario.n_social=1", "scenario.n_followers=0", "scenario.absent_queue_share=0.0"),
    *("scenario.streets.n_training=1", "scenario.streets.n_held_out=12", "scenario.episode_steps=120"),
)
"""One oncoming vehicle on a few streets, for the few tasks: a step of five vehicles takes longest."""


def rates(experiment: str, setting: str, n_episodes: int) -> tuple[float, float]:
    """Shares of success and collision on held-out tasks, as the stage `evaluate` drives them."""
    easy = EASY if experiment in DRAWN and n_episodes == FEW else ()
    exact = [] if experiment == "generalist" else ["policy.precision=float32"]  # objects are seen in float32 anyway
    alone = ["evaluation/baseline=[]", "report.side_by_side=[]", "evaluation.oracle=null"]
    size = f"evaluation.n_episodes={n_episodes}"
    config = compose_config([f"+experiment={experiment}", "device=cpu", "compile=off", size, *alone, *exact, *easy])
    game, policy = build(config)
    load_weights(find_checkpoint("pretrained", config), policy, config)
    (evaluation,) = jobs_of(config, game, policy, {setting: held_out_tasks(config, game, setting)}).values()
    driven = evaluation()
    assert driven is not None
    outcome = driven[0]["outcome"]
    return (outcome == "success").mean(), (outcome == "collision").mean()


@pytest.mark.parametrize(
    "is_few", [pytest.param(True, id="few"), pytest.param(False, marks=pytest.mark.slow, id="many")]
)
@pytest.mark.parametrize(("experiment", "setting"), [(e, s) for e, settings in AT_LEAST.items() for s in settings])
def test_it_succeeds_and_does_not_crash(experiment: str, setting: str, is_few: bool) -> None:
    """In float32, on a machine that knows nothing of the one which trained it."""
    torch.set_num_threads(1)
    n_episodes = FEW if is_few else MANY_DRAWN if experiment in DRAWN else MANY
    success, collision = rates(experiment, setting, n_episodes)
    one = 1 / FEW if experiment in DRAWN and n_episodes == FEW else 0.0  # drawn horizons: a task more or less
    assert success >= AT_LEAST[experiment][setting] - one
    assert collision <= COLLISIONS_AT_MOST[experiment] + one

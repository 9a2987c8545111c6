"""Model card of a run's policy: what it was trained on, what was measured, what it cannot be relied on for."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from negopipe.evaluation.trace import ADAPTIVE
from negopipe.report.description import run_description
from negopipe.report.labels import horizon_label, setting_label
from negopipe.tracking.whole_file import write_whole

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

CARD_NAME = "model_card.md"


def write_model_card(config: "RunConfig", tracked: "TrackedRun", evaluation: Mapping[str, Any]) -> None:
    """Write model_card.md into the run folder and log it as an artifact.

    evaluation: setting -> planner -> measures, of metrics.json
    """
    path = tracked.folder / CARD_NAME
    text = model_card(config, {setting: measures[ADAPTIVE] for setting, measures in evaluation.items()})
    commands = "\n".join(tracked.commands)
    write_whole(path, f"{text}\n## Command\n\n```\n{commands}\n```\n".encode())
    tracked.log_artifact(path)


def model_card(config: "RunConfig", measured: Mapping[str, Mapping[str, Any]]) -> str:
    """The card as Markdown, without the command.

    measured: setting -> the policy's measures
    """
    facts = "\n".join(f"| {name} | {value} |" for name, value in _facts(config))
    rows = "\n".join(_row(setting, measures) for setting, measures in measured.items())
    limits = "\n".join(f"- {limit}" for limit in _limits(config, measured))
    return f"""# {config.name}, seed {config.seed}

{run_description(config)}

| | |
|---|---|
{facts}

## Measured

Held-out tasks, with 95 % intervals.

| setting | episodes | success [%] | collision [%] | driving time [s] |
|---|---|---|---|---|
{rows}

## Limits

{limits}
"""


def _facts(config: "RunConfig") -> Iterator[tuple[str, str]]:
    """Names and values of what the policy sees, chooses and met."""
    yield "sees", config.observation.kind.replace("_", " ")
    horizons = ", ".join(horizon_label(horizon_s) for horizon_s in config.policy.horizons_s)
    yield "chooses among", f"{horizons}, at every decision"
    if "train" not in config.stages:
        return
    yield "tasks of the training", ", ".join(config.curriculum.stages[-1].families)
    yield "drivers of the training", ", ".join(config.population.drivers)
    yield "vehicles", f"the ego and {config.scenario.n_social} oncoming"


def _row(setting: str, measures: Mapping[str, Any]) -> str:
    success, collision = (
        "{:.1f} ({:.1f} to {:.1f})".format(*(100 * measures[f"{name}_{part}"] for part in ("rate", "low", "high")))
        for name in ("success", "collision")
    )
    time_s = measures["driving_time_s"]
    pace = "none" if time_s is None else f"{time_s:.1f}"
    return f"| {setting_label(setting)} | {measures['n_episodes']} | {success} | {collision} | {pace} |"


def _limits(config: "RunConfig", measured: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Sentences."""
    yield "It has never driven a vehicle."
    yield (
        "Nothing is known of other streets, vehicles, drivers and faults of perception than those of the settings "
        "above. `+experiment=unseen` puts a policy to 36 cases of these."
    )
    worst = max(
        measured, key=lambda setting: (measured[setting]["collision_rate"], measured[setting]["collision_high"])
    )
    rate, high = (100 * measured[worst][f"collision_{part}"] for part in ("rate", "high"))
    if rate:
        where = setting_label(worst).lower()
        yield f"Collisions are most frequent in {where}: {rate:.1f} %, by the interval up to {high:.1f} %."
    else:
        yield f"No collision was seen, which by the interval still allows up to {high:.1f} % of the episodes."
    if "train" not in config.stages:
        yield "It was not trained in this run: its training is described where its checkpoint was made."

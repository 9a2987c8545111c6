"""Description of a run and its results, the text at the top of its page in the dashboard."""

from typing import TYPE_CHECKING, Any

from negopipe.report.headlines import headlines, standing
from negopipe.report.labels import planner_label, setting_label
from negopipe.report.page import settings_in_order

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun


def run_description(config: "RunConfig") -> str:
    """Origin of the policy and its evaluation."""
    return f"{config.name}, seed {config.seed}: {_origin(config)}{_evaluation(config)}"


def _evaluation(config: "RunConfig") -> str:
    if "evaluate" not in config.stages:
        return ""
    settings = [setting_label(setting).lower() for setting in config.evaluation.settings]
    baselines = [planner_label(name, config.evaluation.fixed_horizons_s) for name in config.evaluation.baselines] or [
        "no baseline"
    ]
    tasks = f"{config.evaluation.n_episodes:,} held-out tasks each of {' and '.join(settings)}"
    return f" Evaluated on {tasks}, against {', '.join(baselines)}."


def _origin(config: "RunConfig") -> str:
    if "train" not in config.stages:
        return f"the policy of checkpoint {config.checkpoint}." if config.checkpoint else "a policy trained earlier."
    n_decisions = config.algorithm.n_worlds * config.algorithm.n_steps
    stages = ", ".join(f"{stage.name} {stage.n_iterations * n_decisions:,}" for stage in config.curriculum.stages)
    start = f" from checkpoint {config.checkpoint}" if config.checkpoint else ""
    return f"a policy trained by {config.algorithm.kind}{start}, decisions by stage: {stages}{_demonstrations(config)}."


def _demonstrations(config: "RunConfig") -> str:
    demonstrations = config.curriculum.demonstrations
    if demonstrations is None:
        return ""
    n_tasks = demonstrations.n_tasks * len(config.curriculum.stages[-1].families)
    return f", with demonstrations of a search with full knowledge on {n_tasks} training tasks"


def log_summary(config: "RunConfig", run: "TrackedRun", results: dict[str, Any]) -> None:
    """Set the run's description and its tag `standing`, relative to the best of the baselines.

    results: `evaluation` and `versus_adaptive` of metrics.json
    """
    settings = settings_in_order(results["evaluation"], config.evaluation.leading_setting)
    evaluation = {setting: results["evaluation"][setting] for setting in settings}
    verdicts = headlines(evaluation, results["versus_adaptive"], config.evaluation.fixed_horizons_s)
    run.set_tags({"standing": standing(evaluation, results["versus_adaptive"])})
    run.set_description("\n\n".join([run_description(config), *(" ".join(lines) for lines in verdicts)]))

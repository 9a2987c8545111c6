"""The dashboard's view that compares the runs of an experiment, and that the charts' address opens on it."""

import json
from pathlib import Path
from typing import Any

from mlflow import MlflowClient

from negopipe.tracking.dashboard import chart_addresses
from negopipe.tracking.database import connect, database_path
from negopipe.tracking.store import StoreConfig, open_run
from negopipe.tracking.sync.saved_view import LONGEST_TAG, LONGEST_VALUE, N_AXES, TAG, differing

METRIC = "evaluation.yield.adaptive.reward"


def sweep(config: StoreConfig, *resolved: dict[str, Any], metric: str = METRIC) -> str:
    """Runs one after the other; returns the id of their experiment."""
    for number, values in enumerate(resolved):
        with open_run(config, f"seed{values['seed']}-{number}", values) as run:
            run.log_metrics({metric.replace(".", "/"): -6.0}, step=1)
            run.offer_comparison_view([METRIC], {"seed", "outputs"})
    assert run.run_id is not None
    return str(client(config).get_run(run.run_id).info.experiment_id)


def client(config: StoreConfig) -> MlflowClient:
    return connect(Path(config.outputs), config.tracking.uri)


def state(config: StoreConfig, experiment_id: str) -> dict[str, Any]:
    """Of the view, as the dashboard reads it."""
    view = json.loads(client(config).get_experiment(experiment_id).tags[TAG])
    assert view["name"] == "Comparison"
    assert isinstance(view["createdAt"], int)
    return dict(json.loads(view["state"]))


def abbreviate(config: StoreConfig, experiment_id: str) -> list[dict[str, Any]]:
    """The charts of the view."""
    found = state(config, experiment_id)
    sections = {section["uuid"] for section in found["compareRunSections"]}
    assert all(chart["metricSectionId"] in sections for chart in found["compareRunCharts"])
    return list(found["compareRunCharts"])


def test_it_shows_what_differs_and_what_came_of_it(ready: StoreConfig) -> None:
    rates = [{"seed": 1, "outputs": f"o{rate}", "algorithm": {"rate": rate, "kind": "acktr"}} for rate in (0.1, 0.2)]
    (chart,) = abbreviate(ready, sweep(ready, *rates))
    assert chart["type"] == "PARALLEL"
    assert chart["selectedParams"] == ["algorithm.rate"]
    assert chart["selectedMetrics"] == ["evaluation/yield/adaptive/reward"]


def test_seeds_are_an_axis_where_nothing_else_differs(ready: StoreConfig) -> None:
    (chart,) = abbreviate(ready, sweep(ready, {"seed": 1, "gamma": 0.9}, {"seed": 2, "gamma": 0.9}))
    assert chart["selectedParams"] == ["seed"]


def test_a_single_run_is_compared_with_nobody(ready: StoreConfig) -> None:
    assert abbreviate(ready, sweep(ready, {"seed": 1, "gamma": 0.9})) == []


def test_runs_without_the_metric_do_not_count(ready: StoreConfig) -> None:
    sweep(ready, {"seed": 1, "gamma": 0.5}, metric="train.kl")
    assert abbreviate(ready, sweep(ready, {"seed": 3, "gamma": 0.9})) == []


def test_the_other_planners_come_last_and_folded_up(ready: StoreConfig) -> None:
    names = ["evaluation/yield/fixed_0/reward", "train/kl", "evaluation/yield/adaptive/success_rate"]
    for seed in (1, 2):
        with open_run(ready, f"seed{seed}-charts", {"seed": seed}) as run:
            run.log_metrics(dict.fromkeys([*names, METRIC.replace(".", "/")], 0.0), step=1)
            run.offer_comparison_view([METRIC], {"outputs"})
    assert run.run_id is not None
    experiment_id = str(client(ready).get_run(run.run_id).info.experiment_id)
    sections = state(ready, experiment_id)["compareRunSections"]
    expected = {"comparison": True, "evaluation/yield/adaptive": True, "train": True, "evaluation/yield/fixed_0": False}
    assert [(section["name"], section["display"]) for section in sections] == list(expected.items())


def test_axes_are_few_and_their_labels_short() -> None:
    runs = [{f"key{i}": str(run) for i in range(2 * N_AXES)} | {"list": str(run) * LONGEST_VALUE * 2} for run in (1, 2)]
    assert differing(runs, ()) == [f"key{i}" for i in range(2 * N_AXES)]
    assert differing([{"a.b": "1"}, {}], ()) == ["a.b"]
    assert differing([{"a.b": "1"}, {}], {"a"}) == []
    assert differing([], ()) == []


def test_the_charts_open_on_the_view_once_it_is_there(ready: StoreConfig) -> None:
    with open_run(ready, "seed1-view", {"seed": 1}) as run:
        run.begin()
        assert run.charts is not None
        before = run.charts
        run.offer_comparison_view([METRIC], ())
        assert run.charts == f"{before}&viewStateShareKey=comparison"
    assert run.charts in chart_addresses(database_path(Path(ready.outputs)), 5000).values()


def test_a_view_fits_into_a_tag(ready: StoreConfig) -> None:
    many = [{"seed": 1, **{f"{'group' * 6}.key{i}": str(run) * 20 for i in range(40)}} for run in (1, 2)]
    experiment_id = sweep(ready, *many)
    assert len(abbreviate(ready, experiment_id)[0]["selectedParams"]) == N_AXES
    assert len(client(ready).get_experiment(experiment_id).tags[TAG]) < 2000
    with open_run(ready, "seed1-many", {"seed": 1}) as run:
        run.log_metrics({f"evaluation/{'setting' * 10}/planner_{i}/reward": 0.0 for i in range(60)}, step=1)
        run.offer_comparison_view([METRIC], {"outputs"})
    tag = client(ready).get_experiment(experiment_id).tags[TAG]
    assert len(tag) <= LONGEST_TAG
    assert "planner_7" not in tag


def test_telling_it_again_changes_nothing(ready: StoreConfig) -> None:
    experiment_id = sweep(ready, {"seed": 1}, {"seed": 2})
    before = client(ready).get_experiment(experiment_id).tags[TAG]
    with open_run(ready, "seed2-1", {"seed": 2}) as run:
        run.offer_comparison_view([METRIC], {"seed", "outputs"})
    assert client(ready).get_experiment(experiment_id).tags[TAG] == before

"""Saved view of an experiment in MLflow's dashboard: the parameters in which its runs differ, and their results.

MLflow keeps a saved view as a tag of the experiment: a name, two times and, as text, the state of its page of runs. The
page completes a state: it puts a chart of every metric into the section of its name.
"""

import json
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from negopipe.tracking.names import without_implied

if TYPE_CHECKING:
    from mlflow import MlflowClient

VIEW = "comparison"
"""Id of the view, for addresses."""
TAG = f"mlflow.sharedViewState.{VIEW}"
"""Tag of the experiment that holds the view."""

N_AXES = 6
"""Largest number of parameters in the view: more axes are not readable."""
LONGEST_VALUE = 30
"""Longest value of a shown parameter, in characters: longer ones, of whole lists, are no labels of an axis."""
MAX_RUNS = 1000
"""Largest number of runs in the view."""
LONGEST_TAG = 5000
"""Longest tag that MLflow accepts, in characters."""


def save_comparison(
    client: "MlflowClient", experiment_id: str, metrics: Sequence[str], left_out: Collection[str]
) -> None:
    """Save the view of an experiment anew, from the runs that have all `metrics`.

    metrics: axes of the parallel coordinates
    left_out: first parts of the names of parameters that are no axes; the seed is an axis where nothing else differs
    """
    found = client.search_runs([experiment_id], max_results=MAX_RUNS)
    params = [run.data.params for run in found if set(metrics) <= set(run.data.metrics)]
    axes = differing(params, left_out)[:N_AXES] or differing([{"seed": each.get("seed", "")} for each in params], ())
    sections = sorted({name.rpartition("/")[0] for run in found for name in run.data.metrics})
    # the runs' time, not the clock's, so that a second delivery changes nothing
    time_ms = max((run.info.start_time for run in found), default=0)
    for known in (sections, []):  # without its sections a view is short enough for a tag
        state = json.dumps(_state(axes, metrics, known), separators=(",", ":"))
        view = {"name": VIEW.capitalize(), "createdAt": time_ms, "updatedAt": time_ms, "state": state}
        if len(json.dumps(view)) <= LONGEST_TAG:
            break
    client.set_experiment_tag(experiment_id, TAG, json.dumps(view))


def differing(params: Sequence[Mapping[str, str]], left_out: Collection[str]) -> list[str]:
    """Names of parameters that differ among runs and have short values, without those that others imply.

    They are in the order of the first run that has them.
    """
    names = dict.fromkeys(name for each in params for name in each if name.partition(".")[0] not in left_out)
    values = {name: {each.get(name, "") for each in params} for name in names}
    short = [name for name, seen in values.items() if len(seen) > 1 and max(map(len, seen)) <= LONGEST_VALUE]
    return without_implied(short, params)


def _state(axes: Sequence[str], metrics: Sequence[str], sections: Sequence[str]) -> dict[str, Any]:
    """State of the page: the comparison, the sections of `metrics`, all other sections and, folded, their neighbours.

    The neighbours are the other planners, which drive alike in every run.
    """
    compared = {name.rpartition("/")[0] for name in metrics}
    neighbours = {name.partition("/")[0] for name in compared}
    folded = [name for name in sections if name.partition("/")[0] in neighbours and name not in compared]
    unfolded = sorted(set(sections) - set(folded), key=lambda name: (name not in compared, name))
    comparison = {"uuid": VIEW, "name": VIEW, "display": True, "columns": 1, "cardHeight": 420}
    chart = {"uuid": VIEW, "type": "PARALLEL", "metricSectionId": VIEW, "runsCountToCompare": MAX_RUNS}
    chart |= {"selectedParams": list(axes), "selectedMetrics": list(metrics), "showAllRuns": True}
    made_by_hand = {"deleted": False, "isGenerated": False}
    generated = [
        {"uuid": str(number), "name": name, "display": name in unfolded, "isGenerated": True}
        for number, name in enumerate([*unfolded, *folded])
    ]
    return {
        "compareRunSections": [*([comparison | made_by_hand] if axes else []), *generated],
        "compareRunCharts": [chart | made_by_hand] if axes else [],
        "isAccordionReordered": True,  # otherwise the page sorts them by name
        "runsExpanded": {},
    }

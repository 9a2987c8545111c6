"""`make ui`: MLflow's dashboard over the store of an outputs folder, on this machine only."""

import os
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

from negopipe.tracking.database import database_path, is_served
from negopipe.tracking.saved_view import TAG, VIEW

CHARTS = "#/experiments/{}/runs?workflowType=machine_learning&compareRunsMode=CHART"
"""The page of an experiment that opens on the charts of all its runs; MLflow's start page is another one."""
COMPARISON = f"&viewStateShareKey={VIEW}"
"""... with the saved view that compares them first."""
PORT = 5000
"""Of the dashboard, as the Makefile has it."""


def chart_address(experiment_id: str, uri: str | None = None, port: int = PORT, has_view: bool = False) -> str:
    """Where the charts of an experiment are: on the server of the store, if it has one, else on that of `make ui`.

    has_view: the experiment has the saved view that compares its runs
    """
    server = (uri or "").rstrip("/") if is_served(uri) else f"http://127.0.0.1:{port}"
    return f"{server}/{CHARTS.format(experiment_id)}{COMPARISON if has_view else ''}"


def chart_addresses(database: Path, port: int) -> dict[str, str]:
    """Address of the charts by experiment, the experiment with the latest run first."""
    query = """SELECT experiments.name, experiment_id, EXISTS (
                   SELECT * FROM experiment_tags AS tags WHERE tags.experiment_id = runs.experiment_id AND key = ?
               ) FROM experiments JOIN runs USING (experiment_id)
               GROUP BY experiment_id ORDER BY MAX(start_time) DESC"""
    with closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True)) as connection:
        rows = connection.execute(query, (TAG,)).fetchall()
    return {name: chart_address(key, port=port, has_view=bool(has_view)) for name, key, has_view in rows}


def main(outputs: str, port: str) -> None:
    """Print where the charts are, then become the server."""
    database = database_path(Path(outputs))
    if not database.exists():
        sys.exit(f"no runs are recorded under {outputs} yet: try make yield")
    print("The dashboard is ready in some seconds; Ctrl-C stops it. Charts:")
    for name, address in chart_addresses(database, int(port)).items():
        print(f"  {name}: {address}", flush=True)
    os.environ["MLFLOW_SERVER_ENABLE_JOB_EXECUTION"] = "false"  # schedulers for traces, of which there are none
    place = ["--host", "127.0.0.1", "--port", port]
    store = ["--backend-store-uri", f"sqlite:///{database}"]
    quiet = ["--workers", "1", "--uvicorn-opts", "--log-level warning"]
    os.execv(sys.executable, [sys.executable, "-m", "mlflow", "server", *place, *store, *quiet])


if __name__ == "__main__":
    main(*sys.argv[1:])

"""`make ui`: MLflow's dashboard of an outputs folder or of a database at an address, on this machine only.

`python -m negopipe.tracking.dashboard <outputs or sqlite:///file> [<port>]`
"""

import os
import shlex
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

from negopipe.errors import UserError, abbreviate
from negopipe.tracking.database import follow_move, is_served, sqlite_file, store_lock, without_password
from negopipe.tracking.sqlite import address, open_read_only
from negopipe.tracking.sync.saved_view import TAG, VIEW

CHARTS = "#/experiments/{}/runs?workflowType=machine_learning&compareRunsMode=CHART"
"""Address of the page of an experiment with the charts of all its runs, behind that of the server."""
COMPARISON = f"&viewStateShareKey={VIEW}"
"""Addition to the address of the charts, for the saved view that compares the runs."""
PORT = 5000
"""Default port of the dashboard, as in the Makefile."""
OUTPUTS = "outputs"
"""Folder that `make ui` shows, as in the Makefile."""


def chart_address(experiment_id: str, uri: str | None = None, port: int = PORT, has_view: bool = False) -> str:
    """Address of an experiment's charts: on the server of the store, if it has one, else on that of `make ui`.

    has_view: whether the experiment has the saved view that compares its runs
    """
    server = (uri or "").rstrip("/") if is_served(uri) else f"http://127.0.0.1:{port}"
    return f"{server}/{CHARTS.format(experiment_id)}{COMPARISON if has_view else ''}"


def command_for(outputs: Path, uri: str | None) -> str | None:
    """Command for the dashboard of a store; None where the store has a server, which shows its own."""
    if is_served(uri):
        return None
    if uri is None and outputs.absolute() == Path(OUTPUTS).absolute() and Path("Makefile").is_file():
        return "make ui"
    database = sqlite_file(outputs, uri) if uri is not None else None
    place = str(outputs.absolute()) if uri is None else (address(database, "tracking.uri") if database else uri)
    return f"python -m negopipe.tracking.dashboard {shlex.quote(place)}"


def chart_addresses(database: Path, port: int) -> dict[str, str]:
    """Address of the charts by experiment, the experiment with the latest run first."""
    query = """SELECT experiments.name, experiment_id, EXISTS (
                   SELECT * FROM experiment_tags AS tags WHERE tags.experiment_id = runs.experiment_id AND key = ?
               ) FROM experiments JOIN runs USING (experiment_id)
               GROUP BY experiment_id ORDER BY MAX(start_time) DESC"""
    with closing(open_read_only(database)) as connection:
        rows = connection.execute(query, (TAG,)).fetchall()
    return {name: chart_address(key, port=port, has_view=bool(has_view)) for name, key, has_view in rows}


def main(arguments: list[str]) -> int:
    """Print the addresses of the charts, then become the server; 1 after an error line."""
    if not 1 <= len(arguments) <= 2 or arguments[0] in ("-h", "--help"):
        print(__doc__)
        return 0 if arguments in (["-h"], ["--help"]) else 2
    try:
        store, port = _store(arguments[0]), _port(arguments[1] if len(arguments) > 1 else str(PORT))
    except (UserError, sqlite3.Error) as error:
        print(error, file=sys.stderr)
        return 1
    print("The dashboard is ready in some seconds; Ctrl-C stops it. Charts:")
    charts = chart_addresses(store, port) if isinstance(store, Path) else {"all": f"http://127.0.0.1:{port}"}
    for name, place in charts.items():
        print(f"  {name}: {place}", flush=True)
    _serve(address(store, "the store") if isinstance(store, Path) else store, port)
    return 0


def _store(place: str) -> Path | str:
    """SQLite file of an outputs folder or at an address, with its artifact locations updated; else the address."""
    uri = place if "://" in place else None
    if is_served(uri):
        raise UserError(f"the store must be a folder or a database, got {place}: a server shows itself, open it there")
    outputs = Path(place if uri is None else ".").expanduser().absolute()
    database = sqlite_file(outputs, uri)
    if database is None:
        return place
    if not database.exists():
        raise UserError(f"no runs are recorded in {without_password(place)} yet: try make yield")
    if uri is None:
        with store_lock(outputs):
            follow_move(outputs, uri)
    else:
        follow_move(outputs, uri)
    return database


def _port(text: str) -> int:
    if not (text.isdecimal() and 0 < int(text) < 2**16):
        raise UserError(f"the port must be a number from 1 to 65535, got {abbreviate(text)}")
    return int(text)


def _serve(uri: str, port: int) -> None:
    os.environ["MLFLOW_SERVER_ENABLE_JOB_EXECUTION"] = "false"  # its schedulers are for traces, and negopipe has none
    place = ["--host", "127.0.0.1", "--port", str(port)]
    quiet = ["--workers", "1", "--uvicorn-opts", "--log-level warning"]
    os.execv(sys.executable, [sys.executable, "-m", "mlflow", "server", *place, "--backend-store-uri", uri, *quiet])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

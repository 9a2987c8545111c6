"""A tracking server that goes away in the middle of a training and comes back: nothing is missing there."""

import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from mlflow import MlflowClient
from mlflow_server import free_port, server

TRAIN = ("+experiment=smoke", "stages=[train]", "n_threads=1", "tracking.flush_period_s=0.1")


@pytest.mark.slow
def test_what_a_server_missed_it_gets_later(tmp_path: Path) -> None:
    port = free_port()
    arguments = [*TRAIN, f"outputs={tmp_path}/outputs", f"tracking.uri=http://127.0.0.1:{port}"]
    command = [sys.executable, "-m", "negopipe", *arguments]
    with server(tmp_path / "server", port):
        longer = [*command, "algorithm.n_steps=256", "seed=2"]
        training = subprocess.Popen(longer, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        assert training.stdout is not None
        for line in training.stdout:
            if line.startswith("train "):
                break
    rest = training.stdout.read()  # the server is gone
    assert training.wait() == 0
    assert "out of reach" in rest
    without_server = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "out of reach" in without_server.stdout
    assert "lacks entries of" in without_server.stdout
    with server(tmp_path / "server", port) as uri:
        deliver = [sys.executable, "-m", "negopipe.tracking.sync.__main__", f"{tmp_path}/outputs", uri]
        delivered = subprocess.run(deliver, capture_output=True, text=True, check=True).stdout
        assert delivered.count("delivered") == 2
        client = MlflowClient(uri)
        (experiment,) = client.search_experiments(filter_string="name = 'smoke'")
        runs = client.search_runs([experiment.experiment_id])
        assert [run.info.status for run in runs] == ["FINISHED", "FINISHED"]
        for run in runs:
            history = pd.read_csv(Path(run.data.tags["folder"]) / "history.csv")
            losses = [(m.step, m.value) for m in client.get_metric_history(run.info.run_id, "train/policy_loss")]
            assert losses == list(zip(history["decisions"], history["policy_loss"], strict=True))
            assert len(run.outputs.model_outputs) == 3
            assert {file.path for file in client.list_artifacts(run.info.run_id)} >= {"config.yaml", "history.csv"}

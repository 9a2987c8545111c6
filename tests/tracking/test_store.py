"""What a run leaves in the store: values in order, names MLflow takes, the right status however it ends."""

import json
import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from mlflow import MlflowClient
from mlflow.entities import Run

from negopipe.errors import UserError
from negopipe.tracking.dashboard import chart_address, chart_addresses
from negopipe.tracking.names import clean_name, flatten
from negopipe.tracking.store import StoreConfig, TrackedRun, find_store
from negopipe.tracking.store import open_run as open_run_lazily


@contextmanager
def open_run(*arguments: Any, **more: Any) -> Iterator[TrackedRun]:
    """A run that has something to do, and so is known to the store."""
    with open_run_lazily(*arguments, **more) as run:
        run.begin()
        yield run


def but(config: Any, **changes: Any) -> StoreConfig:
    return replace(config, tracking=replace(config.tracking, **changes))


def client_of(config: StoreConfig) -> MlflowClient:
    client = find_store(config)
    assert client is not None
    return client


def record_of(config: StoreConfig, run: TrackedRun) -> Run:
    return client_of(config).get_run(run.run_id)


def history(config: StoreConfig, run: TrackedRun, key: str) -> list[tuple[int, float]]:
    return [(m.step, m.value) for m in client_of(config).get_metric_history(run.run_id, key)]


def test_the_config_is_in_the_folder_the_artifacts_and_the_parameters(config: StoreConfig) -> None:
    resolved = {"seed": 1, "policy": {"conv": [{"kernel": 8}], "text": "x" * 7000}, "none": None, "empty": {}}
    with open_run(config, "seed1-a", resolved) as run:
        run.update_metrics_json({"success": 1.0})
        artifacts = Path(record_of(config, run).info.artifact_uri.removeprefix("file://"))
    assert run.folder == Path(config.outputs) / "case" / "seed1-a"
    for folder in (run.folder, artifacts):
        assert yaml.safe_load((folder / "config.yaml").read_text()) == resolved
        assert json.loads((folder / "metrics.json").read_text()) == {"success": 1.0}
    params = record_of(config, run).data.params
    assert params.pop("policy.text") == "x" * 6000
    assert params == {"seed": "1", "policy.conv": "[{'kernel': 8}]", "none": "None", "empty": "{}"}
    assert artifacts.is_relative_to(config.outputs)


def test_more_parameters_than_one_call_takes_all_arrive(config: StoreConfig) -> None:
    with open_run(config, "seed1-b", {f"key{i}": i for i in range(250)}) as run:
        pass
    assert record_of(config, run).data.params == {f"key{i}": str(i) for i in range(250)}


def test_buffered_metrics_all_arrive_in_order_when_the_run_ends(config: StoreConfig) -> None:
    with open_run(but(config, n_metrics_per_flush=2500), "seed1-c", {}) as run:
        for step in range(1200):
            run.log_metrics({"train/loss": step / 2, "train/return [max]": -step}, step)
        assert history(config, run, "train/loss") == []
    assert history(config, run, "train/loss") == [(step, step / 2) for step in range(1200)]
    assert history(config, run, "train/return _max_") == [(step, -step) for step in range(1200)]


def test_metrics_are_written_when_there_are_many_or_it_is_late(config: StoreConfig) -> None:
    with open_run(but(config, n_metrics_per_flush=3), "seed1-d", {}) as run:
        for step in range(4):
            run.log_metrics({"x": step}, step)
        assert len(history(config, run, "x")) == 3
    with open_run(but(config, flush_period_s=0.05), "seed2-d", {}) as run:
        time.sleep(0.06)
        run.log_metrics({"x": 1}, 1)
        assert len(history(config, run, "x")) == 1


@pytest.mark.parametrize(
    ("name", "clean"),
    [
        ("train/loss", "train/loss"),
        ("a=b@c%d[0]", "a_b_c_d_0_"),
        ("a//b/", "a/b"),
        ("../a/./b", "a/b"),
        ("success rate: push", "success rate: push"),
    ],
)
def test_names_become_what_mlflow_takes(name: str, clean: str) -> None:
    from mlflow.utils.validation import _validate_metric_name

    assert clean_name(name) == clean
    _validate_metric_name(clean)


def test_flatten_joins_keys_and_keeps_lists() -> None:
    assert flatten({"a": {"b": {"c": 1}}, "d": [{"e": 2}], "f": {}}) == {"a.b.c": 1, "d": [{"e": 2}], "f": {}}


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (ValueError(), "FAILED"),
        (UserError("no"), "FAILED"),
        (KeyboardInterrupt(), "KILLED"),
        (SystemExit(143), "KILLED"),
    ],
    ids=repr,
)
def test_a_run_that_is_stopped_says_so_and_keeps_its_metrics(
    config: StoreConfig, error: BaseException, status: str
) -> None:
    def stop() -> None:
        run.log_metrics({"x": 1}, 0)
        raise error

    with pytest.raises(type(error)), open_run(config, "seed1-e", {}) as run:
        stop()
    assert record_of(config, run).info.status == status
    assert history(config, run, "x") == [(0, 1.0)]


def test_a_run_folder_belongs_to_one_run_at_a_time(config: StoreConfig) -> None:
    in_use = pytest.raises(UserError, match=r"seed1-g is in use by another process: [^\n]+$")
    with open_run(config, "seed1-g", {}), in_use, open_run(config, "seed1-g", {}):
        pass
    with open_run(config, "seed1-g", {}):  # free again
        pass


def test_checkpoints_are_models_of_the_run_and_versions_in_the_registry(config: StoreConfig) -> None:
    file = Path(config.outputs) / "checkpoint.safetensors"
    file.write_bytes(b"weights")
    for seed in (1, 2):  # the second finds the registered model there
        with open_run(but(config, registered_model="policy"), f"seed{seed}-h", {}) as run:
            run.log_checkpoint(file, 20, {}, is_final=False)  # no version
            run.log_checkpoint(file, 40, {"evaluate/success": 0.5})
    client = client_of(config)
    early, output = sorted(record_of(config, run).outputs.model_outputs, key=lambda each: each.step)
    assert early.step == 20
    model = client.get_logged_model(output.model_id)
    assert (str(model.status), model.params, output.step) == ("READY", {"step": "40"}, 40)
    assert [(m.key, m.value, m.step) for m in model.metrics] == [("evaluate/success", 0.5, 40)]
    versions = client.search_model_versions("name='policy'")
    assert sorted(int(version.version) for version in versions) == [1, 2]
    assert f"models:/{output.model_id}" in {version.source for version in versions}


def test_description_tags_and_folders_of_artifacts(config: StoreConfig) -> None:
    figures = Path(config.outputs) / "figures"
    figures.mkdir()
    (figures / "a.svg").write_text("<svg/>")
    with open_run(config, "seed1-i", {}) as run:
        run.set_description("# Yield")
        run.set_tags({"sweep": "three seeds"})
        run.log_artifact(figures, "figures")
        run.log_artifact(figures / "a.svg")
    tags = record_of(config, run).data.tags
    assert (tags["mlflow.note.content"], tags["sweep"]) == ("# Yield", "three seeds")
    names = {file.path for file in client_of(config).list_artifacts(run.run_id)}
    assert names == {"config.yaml", "figures", "a.svg"}
    assert [f.path for f in client_of(config).list_artifacts(run.run_id, "figures")] == ["figures/a.svg"]


def test_another_store_can_be_named(config: StoreConfig, tmp_path: Path) -> None:
    other = but(config, uri=f"sqlite:///{tmp_path}/other.db", experiment="elsewhere")
    with open_run(other, "seed1-j", {}) as run:
        pass
    assert list(chart_addresses(tmp_path / "other.db", 5000)) == ["elsewhere"]
    assert record_of(other, run).info.status == "FINISHED"
    with pytest.raises(UserError, match=r"^tracking\.uri must be a store that MLflow can open, got nonsense:"):
        open_run(but(config, uri="nonsense://x"), "seed1-k", {}).__enter__()


def test_the_dashboard_lists_experiments_latest_first(config: StoreConfig) -> None:
    for seed, name in enumerate(("early", "late", "early")):
        with open_run(but(config, experiment=name), f"seed{seed}-l", {}):
            time.sleep(0.002)
    addresses = chart_addresses(Path(config.outputs) / "mlflow" / "mlflow.db", 5001)
    assert list(addresses)[:2] == ["early", "late"]
    assert addresses["late"].startswith("http://127.0.0.1:5001/#/experiments/")
    assert chart_address("7", "http://host:8000/").startswith("http://host:8000/#/experiments/7/")


def test_a_run_knows_where_its_charts_are(config: StoreConfig) -> None:
    with open_run_lazily(config, "seed1-charts", {}) as run:
        assert run.charts is None
        run.begin()
        addresses = chart_addresses(Path(config.outputs) / "mlflow" / "mlflow.db", 5000)
        assert run.charts in addresses.values()


def test_a_first_start_that_is_killed_does_not_spoil_the_store(
    empty: StoreConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def die(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as killed:
        killed.setattr("os.replace", die)  # the tables are made by then
        with pytest.raises(KeyboardInterrupt), open_run(empty, "seed1-n", {}):
            pass
    assert find_store(empty) is None
    with open_run(empty, "seed1-n", {}) as run:
        pass
    assert record_of(empty, run).info.status == "FINISHED"
    assert not list(Path(empty.outputs).rglob("*.draft"))


def test_a_first_start_is_quiet_and_stays_in_outputs(
    empty: StoreConfig, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    logging.basicConfig(level=logging.INFO, stream=sys.stdout, force=True)
    with open_run(empty, "seed1-m", {}) as run:
        run.log_metrics({"x": 1}, 0)
    assert capfd.readouterr() == ("", "")
    assert [path.name for path in tmp_path.iterdir()] == ["outputs"]
    assert sorted(path.name for path in Path(empty.outputs).iterdir()) == ["case", "mlflow"]


def test_a_killed_run_goes_on_in_its_record_and_writes_nothing_twice(config: StoreConfig) -> None:
    file = Path(config.outputs) / "again.safetensors"
    file.write_bytes(b"weights")

    def stop() -> None:
        first.log_metrics({"loss": 0.0}, 0)
        first.log_metrics({"loss": 1.0}, 1)
        first.log_checkpoint(file, 1, {})
        first.mark_finished("train", "key")
        raise SystemExit(143)

    with pytest.raises(SystemExit), open_run(config, "seed1-o", {"a": 1}, source="x") as first:
        stop()
    with open_run(config, "seed1-o", {"a": 2, "b": 3}, source="x") as again:
        assert record_of(config, again).info.status == "RUNNING"
        assert again.has_finished("train", "key")
        assert not again.has_finished("train", "other key")
        assert not again.has_finished("evaluate", "key")
        again.log_metrics({"loss": 1.0}, 1)
        again.log_metrics({"loss": 2.0, "new": 5.0}, 2)
        again.log_checkpoint(file, 1, {})
        again.log_checkpoint(file, 2, {})
    assert again.run_id == first.run_id
    record = record_of(config, again)
    assert record.info.status == "FINISHED"
    assert record.data.params == {"a": "1", "b": "3"}  # the store does not let go of what it was told
    assert history(config, again, "loss") == [(0, 0.0), (1, 1.0), (2, 2.0)]
    assert history(config, again, "new") == [(2, 5.0)]
    assert sorted(output.step for output in record.outputs.model_outputs) == [1, 2]


def test_a_run_killed_before_its_checkpoint_logs_the_metrics_of_that_step_once(config: StoreConfig) -> None:
    file = Path(config.outputs) / "later.safetensors"
    file.write_bytes(b"weights")

    def stop() -> None:
        first.log_metrics({"loss": 1.0}, 1)
        raise SystemExit(143)

    with pytest.raises(SystemExit), open_run(config, "seed1-p", {}) as first:
        stop()
    time.sleep(0.01)  # the clock of the store counts milliseconds
    with open_run(config, "seed1-p", {}) as again:
        again.log_metrics({"loss": 1.0}, 1)
        again.log_checkpoint(file, 1, {"loss": 1.0})
    assert history(config, again, "loss") == [(1, 1.0)]


@pytest.mark.parametrize(
    ("source", "takes_any_code", "is_fresh", "is_same"),
    [("x", False, False, True), ("y", True, False, True), ("y", False, False, False), ("x", True, True, False)],
)
def test_other_code_and_who_asks_for_it_begin_anew(
    config: StoreConfig, source: str, takes_any_code: bool, is_fresh: bool, is_same: bool
) -> None:
    name = f"seed1-p{source}{takes_any_code}{is_fresh}"
    with open_run(config, name, {}, source="x") as first:
        first.mark_finished("train", "key")
        (first.folder / "snapshots").mkdir()
    with open_run(config, name, {}, None, source, takes_any_code, is_fresh) as second:
        assert (second.run_id == first.run_id) == is_same
        assert second.has_finished("train", "key") == is_same
        assert (second.folder / "snapshots").exists() == is_same


def test_what_other_code_finished_counts_only_where_any_code_does(config: StoreConfig) -> None:
    with open_run(config, "seed1-r", {}, source="x") as first:
        first.mark_finished("train", "key")
    with open_run(config, "seed1-r", {}, source="y", takes_any_code=True) as any_code:
        any_code.mark_finished("evaluate", "key")
        assert any_code.has_finished("train", "key")
    with open_run(config, "seed1-r", {}, source="y") as same_code:
        assert same_code.run_id == first.run_id
        assert same_code.has_finished("evaluate", "key")
        assert not same_code.has_finished("train", "key")


def test_a_record_that_is_damaged_or_lost_by_the_store_begins_anew(
    config: StoreConfig, caplog: pytest.LogCaptureFixture
) -> None:
    for damage in ("{", '{"run_id": "0123", "source": "x", "finished": {"train": "key"}}'):
        with open_run(config, "seed1-q", {}, source="x") as first:
            pass
        (first.folder / "record.json").write_text(damage)
        with open_run(config, "seed1-q", {}, source="x") as second:
            assert second.run_id != first.run_id
            assert not second.has_finished("train", "key")
    assert "is no record of a run" in caplog.text

"""A run keeps the command that made each stage, whatever is run in its folder later."""

import json
from collections.abc import Sequence
from pathlib import Path

from negopipe.report.provenance import provenance
from negopipe.tracking.record import RunRecord, as_command, read_record, write_record
from negopipe.tracking.store import StoreConfig, TrackedRun, find_store, open_run


def work(config: StoreConfig, overrides: str, stages: Sequence[str], sweep: str | None = None) -> TrackedRun:
    tags = {"overrides": overrides} | ({"sweep": sweep} if sweep else {})
    with open_run(config, "one", {}, tags=tags) as run:
        run.begin()
        for stage in stages:
            run.mark_finished(stage, "key")
    return run


def stored_tags(config: StoreConfig, run: TrackedRun) -> dict[str, str]:
    client = find_store(config)
    assert client is not None
    return client.get_run(run.run_id).data.tags


def test_a_replay_does_not_take_a_runs_command(ready: StoreConfig) -> None:
    work(ready, "seed=1 'name=a b'", ["train", "evaluate", "report"], sweep="rates")
    run = work(ready, "seed=1 'stages=[replay]' episode=x/y/1", ["replay"])
    record = read_record(run.folder)
    assert record is not None
    assert record.commands() == ["seed=1 'name=a b'"]
    assert record.finished["replay"]["overrides"] == "seed=1 'stages=[replay]' episode=x/y/1"
    assert record.tags == {"overrides": "seed=1 'name=a b'", "sweep": "rates"}, "it is still a run of its sweep"
    assert stored_tags(ready, run)["overrides"] == "seed=1 'name=a b'"


def test_stages_made_one_by_one_keep_a_command_each(ready: StoreConfig) -> None:
    work(ready, "stages=[train]", ["train"])
    run = work(ready, "stages=[evaluate]", ["evaluate"])
    record = read_record(run.folder)
    assert record is not None
    assert record.commands() == ["stages=[train]", "stages=[evaluate]"]
    assert stored_tags(ready, run)["overrides"] == "stages=[evaluate]"


def test_a_report_tells_the_commands_of_the_results_and_its_own(ready: StoreConfig) -> None:
    work(ready, "", ["train", "evaluate", "report"])
    with open_run(ready, "one", {}, tags={"overrides": "'stages=[report]'"}) as run:
        run.begin()
        made = provenance(7, run)
    assert made.command == "python -m negopipe\npython -m negopipe 'stages=[report]'"
    assert made.seed == "7"


def test_a_record_of_before_is_read_by_its_tag(tmp_path: Path) -> None:
    old = {"key": "k", "source": "s", "tags": {"overrides": "seed=1"}}
    (tmp_path / "record.json").write_text(
        json.dumps({**old, "finished": {"train": {"config": "c", "source": "s"}}}), encoding="utf-8"
    )
    record = read_record(tmp_path)
    assert record is not None
    assert record.with_tags({"overrides": "stages=[replay]", "sweep": "x"}).tags == {
        "overrides": "seed=1",
        "sweep": "x",
    }
    assert record.commands() == ["seed=1"]
    assert RunRecord("k", "s").commands() == []
    write_record(tmp_path, record)
    assert read_record(tmp_path) == record


def test_a_command_without_overrides_is_one() -> None:
    assert as_command("") == "python -m negopipe"
    assert RunRecord("k", "s", {"overrides": ""}).commands() == [""]

"""Groups of runs and their names."""

from pathlib import Path

from swept import make_run

from negopipe.sweeping.groups import ALL_RUNS, DEFAULT, Groups, group_runs, short_names
from negopipe.sweeping.swept_runs import read_runs


def groups(outputs: Path, *by: str) -> Groups:
    return group_runs(read_runs([outputs / "yield"]), by)


def sizes(found: Groups) -> dict[str, int]:
    return {name: len(runs) for name, runs in found.items()}


def test_seeds_of_a_config_are_one_group_named_by_its_overrides(tmp_path: Path) -> None:
    for seed in (1, 2, 3):
        make_run(tmp_path, seed, 0.1, -8.0)
    assert sizes(groups(tmp_path)) == {ALL_RUNS: 3}
    for seed in (1, 2):
        make_run(tmp_path, seed, 0.2, -8.0)
    assert sizes(groups(tmp_path)) == {"algorithm.rate=0.1": 3, "algorithm.rate=0.2": 2}
    assert sizes(groups(tmp_path, "reward.kind", "algorithm.rate")) == {"paper, 0.1": 3, "paper, 0.2": 2}
    assert sizes(groups(tmp_path, "reward.kind")) == {"paper": 5}


def test_the_group_that_no_override_sets_apart_is_the_default(tmp_path: Path) -> None:
    make_run(tmp_path, 1, 0.1, -8.0, tags={"overrides": "+experiment=yield seed=1"})
    make_run(tmp_path, 1, 0.2, -8.0)
    assert list(groups(tmp_path)) == [DEFAULT, "algorithm.rate=0.2"]


def test_where_no_command_is_recorded_keys_that_differ_name_the_group(tmp_path: Path) -> None:
    for rate in (0.1, 0.2):
        make_run(tmp_path, 1, rate, -8.0, tags={})
    assert list(groups(tmp_path)) == ["algorithm.rate=0.1", "algorithm.rate=0.2"]


def test_baselines_set_no_policies_apart(tmp_path: Path) -> None:
    make_run(tmp_path, 1, 0.1, -8.0, evaluation={"baselines": {"fixed_2": {"horizons_s": [2.0]}}})
    make_run(tmp_path, 2, 0.1, -8.0)
    assert sizes(groups(tmp_path)) == {ALL_RUNS: 2}


def test_long_names_become_letters() -> None:
    assert short_names(["a=1", "a=2"]) == {"a=1": "a=1", "a=2": "a=2"}
    assert list(short_names(["a=1", "b" * 40]).values()) == ["A", "B"]

"""The scripts of jobs/: each can be loaded, does what it says at small size, and refers to what there is."""

import importlib.util
import re
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
import torch
import yaml
from scripts import JOBS, load_script

from negopipe.game.game import build_game
from negopipe.safety.layer import INTERVENTIONS
from negopipe.search.oracle_table import ORACLE_TABLE
from negopipe.tracking import pretrained
from negopipe.tracking.checkpoint import load_checkpoint
from negopipe.tracking.csv_file import read_csv, write_csv
from negopipe.training.training import Training

ROOT = JOBS.parent
WITH_REFERENCES = [
    *sorted(path for path in JOBS.glob("*.*") if path.suffix in (".py", ".sh", ".md")),
    *(
        ROOT / name
        for name in ("README.md", "CONTRIBUTING.md", "Makefile", "jobs/results/README.md", "outputs/README.md")
    ),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "conf").rglob("*.yaml")),
    *sorted((ROOT / "negopipe").rglob("*.py")),
]
FILE = re.compile(r"(?<![\w/.>])(?:jobs|conf|negopipe|tests|docs)/[\w/.-]*\.(?:py|sh|md|yaml|csv|png|gif)")


@pytest.mark.parametrize("name", sorted(path.stem for path in JOBS.glob("*.py")))
def test_a_script_can_be_loaded(name: str) -> None:
    assert load_script(name).__doc__


def test_what_is_referred_to_is_there() -> None:
    texts = {path: path.read_text(encoding="utf-8") for path in WITH_REFERENCES}

    def missing(pattern: str | re.Pattern[str], is_there: Callable[[str], bool]) -> list[tuple[Path, str]]:
        named = [(path, name) for path, text in texts.items() for name in set(re.findall(pattern, text))]
        return [(path, name) for path, name in named if not is_there(name)]

    assert not missing(FILE, lambda name: (ROOT / name).exists())
    assert not missing(r"\+experiment=(\w+)", lambda name: (ROOT / "conf/experiment" / f"{name}.yaml").exists())
    assert not missing(r"python -m (negopipe[\w.]*)", lambda name: importlib.util.find_spec(name) is not None)


def test_every_script_has_its_row() -> None:
    rows = re.findall(r"^\| `([\w.]+)` \|", (JOBS / "README.md").read_text(encoding="utf-8"), flags=re.M)
    told = {path.name for path in JOBS.glob("*.*") if path.suffix in (".py", ".sh")}
    assert set(rows) == told - {"scenario_study.py"}  # of which scenario_study.sh makes use


def test_first_glance_on_what_comes_with_negopipe(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = read_csv(pretrained.find_oracle("pretrained"), ORACLE_TABLE)
    few = table[table["setting"].isin(["push", "mixture"]) & (table["episode"] < 3)]
    write_csv(tmp_path / "oracle.csv", few, ORACLE_TABLE)
    load_script("first_glance").main(tmp_path / "oracle.csv", is_compiled=False)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["push", "mixture"]
    for line, (_, rows) in zip(lines, few.groupby("setting", sort=False), strict=True):
        best, per_group, for_all = map(float, re.findall(r"-?\d+\.\d\d", line))
        assert best == pytest.approx(rows["reward"].mean(), abs=0.01)
        assert 0 <= per_group <= for_all


def road(folder: Path, length_m: float, succeeds: list[list[bool]], oracle: bool) -> None:
    """A run of the study; `succeeds`: of each fixed horizon, against each style."""
    styles = [0.0, 2.0, 4.0, 6.0]
    won = {True: "success", False: "deadlock"}
    rows = {"setting": "mixture", "episode": range(4), "style_horizon_s": styles, "outcome": won[oracle]}
    rows |= {f"fixed_{2 * i}_outcome": [won[one] for one in each] for i, each in enumerate(succeeds)}
    table = pd.DataFrame(rows)
    write_csv(folder / "oracle.csv", pd.concat([table, table.assign(setting="yield")]), ORACLE_TABLE)
    sizes = {"corridor_length_m": length_m, "corridor_gap_m": 3.2, "swerve_length_m": 12.0}
    config = {"scenario": {"road": sizes, "desired_speed_mps": [6.0, 6.0]}}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))


def test_scenario_study_picks_by_its_rule(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study = load_script("scenario_study")
    assert study.main(tmp_path) == 1
    assert "must hold runs of +experiment=scenario_study" in capsys.readouterr().err
    half = [[False, False, True, True]] * 4
    road(tmp_path / "easy", 10.0, [[True] * 4] * 4, oracle=True)
    road(tmp_path / "hard", 12.0, half, oracle=True)
    road(tmp_path / "hopeless", 18.0, [[False] * 4] * 4, oracle=False)
    assert study.main(tmp_path) == 0
    said = capsys.readouterr().out
    assert "pick, one of 1 in which the best fixed horizon does worst: {'corridor_m': 12.0" in said
    assert "while a sequence does: 0 of 3" in said


def test_passable_streets_counts_what_two_planners_resolve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    job = load_script("passable_streets")
    driven = pd.DataFrame({"street": [2, 3, 3, 4], "style_s": [0.0, 0.0, 6.0, 6.0]})
    driven["cautious"] = ["success", "collision", "success", "deadlock"]
    driven["ego_2_social_6"] = ["success", "timeout", "success", "collision"]
    driven["ego_6_social_2"] = ["collision", "success", "success", "deadlock"]
    monkeypatch.setattr(job, "driven", lambda config, game: driven)
    job.main(tmp_path / "table.csv", 2, ["scenario.streets.seed=5"])
    said = capsys.readouterr().out
    assert "two planners resolve 3 of 2 tasks, on 2 streets" in said
    found = pd.read_csv(tmp_path / "table.csv")
    assert found["style_s"].tolist() == ["all", "0", "6"]
    assert found["n_tasks"].tolist() == [3, 2, 1]
    assert found["success_rate"].tolist() == [0.6667, 0.5, 1.0]
    assert found["collision_rate"].tolist() == [0.3333, 0.5, 0.0]


def test_passable_streets_drives_each_task_three_times() -> None:
    job = load_script("passable_streets")
    config = job.config_of(2, ["scenario.episode_steps=2"])
    assert (config.scenario.streets.n_held_out, config.evaluation.n_episodes) == (2, 2)
    table = job.driven(config, build_game(config))
    assert len(table) == 2
    assert set(table["street"]) <= {2, 3}
    assert table[["cautious", "ego_2_social_6", "ego_6_social_2"]].isin(["timeout", "deadlock"]).all(axis=None)


def test_a_shipped_policy_is_the_checkpoint_with_its_encoder_rounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = pretrained.FOLDER / "yield.safetensors"
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path / "pretrained")
    path = load_script("ship_policy").ship(source, "other")
    assert pretrained.names() == ["other"]
    tensors, metadata = load_checkpoint(path)
    original, of_original = load_checkpoint(source)
    assert metadata == of_original
    assert {str(x.dtype) for key, x in tensors.items() if key.startswith("encoder.")} == {"torch.bfloat16"}
    for key, values in tensors.items():
        is_rounded = values.dtype == torch.bfloat16
        assert torch.equal(values, original[key].bfloat16() if is_rounded else original[key])


def test_the_speed_of_environments_is_measured(tmp_path: Path) -> None:
    script = load_script("environments")
    script.main(4, tmp_path / "speed.csv", (("single", 1), ("sync", 2), ("batched", 2)))
    table = read_csv(tmp_path / "speed.csv", script.TABLE)
    assert table["way"].tolist() == ["single", "sync", "batched"] * 2
    assert (table["decisions_per_s"] > 0).all()
    assert (table.loc[table["way"] == "single", "times_single"] == 1).all()


def test_the_model_of_many_ranks_is_made_of_the_measured_rows() -> None:
    job, results = load_script("ranks_speed"), ROOT / "jobs" / "results"
    rows = pd.DataFrame(job.model(pd.read_csv(results / "ranks_speed.csv")))
    pd.testing.assert_frame_equal(rows, pd.read_csv(results / "ranks_model.csv"))
    network = job.Network(latency_s=1e-3, bytes_per_s=1e6)
    assert job.all_reduce_s(1e6, 2, network) == pytest.approx(2e-3 + 1.0)
    assert job.all_gather_s(1e6, 4, network) == pytest.approx(2e-3 + 3.0)


@pytest.mark.slow
def test_ablation_trains_and_drives_a_variant_once(tmp_path: Path) -> None:
    job = load_script("ablation_generalist")
    few = ["compile=off", "algorithm.n_worlds=4", "algorithm.n_steps=2"]
    assert job.train(tmp_path, "one_street", 1, 2, few).startswith("one_street-1.safetensors after")
    assert job.train(tmp_path, "one_street", 1, 2, few) == "one_street-1.safetensors is there"
    assert job.drive(tmp_path, ["one_street"], [1, 1], 2, "driver_idm").endswith("% success")
    row, same = read_csv(tmp_path / "one_street.driver_idm.2.csv", job.TABLE).to_dict("records")
    assert same == row
    assert (row["variant"], row["case"], row["n_episodes"]) == ("one_street", "driver_idm", 2)
    assert row["success"] + sum(row[each] for each in ("collision", "deadlock", "timeout", "social_collision")) == 1


@pytest.mark.slow
def test_ablation_goes_on_with_a_training_that_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = load_script("ablation_generalist")
    few = ["compile=off", "algorithm.n_worlds=4", "algorithm.n_steps=2"]
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    whole.mkdir()
    job.train(whole, "as_shipped", 1, 3, few)
    iterate = job.Training.iterate

    def iterate_until_stopped(training: Training) -> dict:
        if training.n_done == 2:
            raise KeyboardInterrupt
        return iterate(training)

    with monkeypatch.context() as patch:
        patch.setattr(job.Training, "iterate", iterate_until_stopped)
        with pytest.raises(KeyboardInterrupt):
            job.train(stopped, "as_shipped", 1, 3, few)
    job.train(stopped, "as_shipped", 1, 3, few)
    name = "as_shipped-1.safetensors"
    assert (stopped / name).read_bytes() == (whole / name).read_bytes()
    assert not list(stopped.rglob("0*.safetensors"))


@pytest.mark.slow
def test_attainable_is_what_a_planner_or_a_sequence_solves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = load_script("attainable")
    solved = pd.DataFrame([[True, False, False], [True, True, None]], index=["driver_idm", "street_wide"])
    monkeypatch.setattr(job, "solved", lambda outputs: solved)
    monkeypatch.setattr(job, "sequences", lambda n_actions, n_steps: [torch.full((1, n_steps), n_actions - 1)])
    job.main(tmp_path / "table.csv", [])
    idm, wide = read_csv(tmp_path / "table.csv", job.TABLE).to_dict("records")
    assert (idm["n_tasks"], idm["n_solved"]) == (3, 1)
    assert idm["n_found"] == 2 - len(idm["not_found"].split())
    assert idm["attainable"] == pytest.approx((1 + idm["n_found"]) / 3, abs=1e-4)
    assert (wide["n_tasks"], wide["n_solved"], wide["attainable"]) == (2, 2, 1.0)


def test_sequences_have_a_switch_at_most() -> None:
    first, *later = load_script("attainable").sequences(3, 60)
    assert first.tolist() == [[0] * 60, [1] * 60, [2] * 60]
    for actions in later:
        assert actions.shape == (6, 60)
        assert ((actions.diff(dim=1) != 0).sum(1) == 1).all()


def test_ablation_knows_who_drives_with_the_same_agent() -> None:
    job = load_script("ablation_generalist")
    assert job.by_agent(["as_shipped", "grids", "one_street"]) == [["as_shipped", "one_street"], ["grids"]]


def test_ablation_means_count_cases_and_seeds_alike() -> None:
    job = load_script("ablation_generalist")
    rows = pd.DataFrame({"variant": ["a"] * 3 + ["b"], "seed": [1, 1, 2, 1], "case": ["x", "y", "x", "x"]})
    rows = rows.assign(
        success=[0.0, 0.5, 0.75, 0.75], collision=0.0, deadlock=0.25, driving_time_s=[10.0, 12.0, 13.0, 9.0]
    )
    first, second = job.means(rows).to_dict("records")
    assert (first["variant"], first["success"], first["n_cases"], first["n_seeds"]) == ("b", 0.75, 1, 1)
    assert (second["success"], second["success_low"], second["success_high"]) == (0.5, 0.25, 0.75)
    assert second["driving_time_s"] == 12.0


def test_safety_drives_what_is_missing_and_sums_it(tmp_path: Path) -> None:
    job = load_script("safety")
    pieces, attacked = tmp_path / "pieces", ["--attacks", "random", "nan_plan", "--tasks", "2"]
    words = [str(tmp_path / "table.csv"), str(pieces), *attacked, "--overrides", "scenario.episode_steps=6"]
    job.main(job.parser().parse_args([*words, "--cases", "yield/push"]))
    first = {path: path.stat().st_mtime_ns for path in pieces.iterdir()}
    job.main(job.parser().parse_args([*words, "--cases", "yield/push", "yield/yield"]))
    assert {path: path.stat().st_mtime_ns for path in first} == first
    table = read_csv(tmp_path / "table.csv", job.TABLE).set_index(["case", "attack", "layer"]).sort_index()
    assert table["n_episodes"].to_dict() == {
        (case, attack, layer): 4 if case == "all" else 2
        for case in ("all", "yield/push", "yield/yield")
        for attack, layer in (("random", "none"), ("random", "rss"), ("nan_plan", "rss"))
    }
    sums = table.drop("all")[["n_decisions", *INTERVENTIONS[1:]]].groupby(["attack", "layer"]).sum()
    assert (table.loc["all"][sums.columns] == sums).all(axis=None)
    assert table.loc[("all", "nan_plan", "rss"), "touched_percent"] > 10  # a third of the plans is lost
    assert (table.xs("none", level="layer")["touched_percent"] == 0).all()

"""A stage's key changes with what its result depends on, and with nothing else."""

from pathlib import Path

import pytest
from composed import compose_config

from negopipe.runtime.identity import DEPENDS_ON, source_hash, stage_key
from negopipe.tracking.checkpoint import save_checkpoint

ALL = set(DEPENDS_ON)


@pytest.mark.parametrize(
    ("override", "changed"),
    [
        ("seed=2", ALL),
        ("planner.horizon_s=6.2", ALL),
        ("algorithm.gamma=0.5", {"train", "evaluate", "report", "replay", "cross_play", "benchmark", "export"}),
        ("evaluation.n_episodes=400", ALL - {"train", "streets"}),
        ("evaluation.leading_setting=push", {"preview", "report"}),
        ("scenario.families.mixture.start_distance_m=[12.0,13.0]", ALL - {"train"}),
        ("oracle.rounds=3", {"oracle"}),
        ("export.opset=18", {"export"}),
        ("report.n_animations=3", {"preview", "report", "replay", "behaviour_map", "cross_play", "streets"}),
        ("episode=push/adaptive/1", {"replay"}),
        ("encounter=one.json", {"replay"}),
        ("play.port=1", set()),
        ("evaluation.oracle=nowhere.csv", ALL - {"train", "streets"}),
        ("n_threads=1", {"benchmark"}),
        ("policy.precision=bfloat16", {"train", "evaluate", "report", "replay", "cross_play", "benchmark", "export"}),
        ("policy.memory_format=channels_first", {"benchmark"}),
        ("tracking.flush_period_s=1.0", {"benchmark"}),
        ("name=other", set()),
        ("outputs=elsewhere", set()),
        ("reuse=any_code", set()),
        ("rerun=true", set()),
    ],
)
def test_keys_change_with_what_results_depend_on(override: str, changed: set[str]) -> None:
    base, other = compose_config(), compose_config([override])
    assert {stage for stage in ALL if stage_key(base, stage) != stage_key(other, stage)} == changed


def test_the_report_depends_on_the_map_where_it_shows_one() -> None:
    stages, more = "stages=[evaluate,behaviour_map,report]", "behaviour_map.n_episodes=3"
    keys = [stage_key(compose_config(overrides), "report") for overrides in ([stages], [stages, more], [], [more])]
    assert keys[0] != keys[1]
    assert keys[2] == keys[3]


def test_a_checkpoint_counts_by_its_content_and_by_what_is_done_with_it(tmp_path: Path) -> None:
    one, same, other = (tmp_path / name for name in ("one", "same", "other"))
    for path, step in ((one, 1), (same, 1), (other, 2)):
        save_checkpoint(path, {}, {"step": step})

    def key(stage: str, path: Path, stages: str) -> str:
        return stage_key(compose_config([f"checkpoint={path}", f"stages=[{stages}]"]), stage)

    assert key("evaluate", one, "evaluate") == key("evaluate", same, "evaluate")
    assert key("evaluate", one, "evaluate") != key("evaluate", other, "evaluate")
    assert key("evaluate", one, "evaluate") != key("evaluate", one, "train,evaluate")
    assert key("benchmark", one, "benchmark") == key("benchmark", other, "benchmark")


def test_the_code_has_one_hash() -> None:
    assert source_hash() == source_hash()
    assert len(source_hash()) == 16

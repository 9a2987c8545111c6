"""The model card of a run says what its policy is, what was measured and what it cannot do."""

from pathlib import Path

from composed import compose_config
from tracked import RecordedRun

from negopipe.report.model_card import model_card, write_model_card


def measures(collision: float) -> dict[str, float | None]:
    return {
        "n_episodes": 200,
        "success_rate": 0.9,
        "success_low": 0.85,
        "success_high": 0.94,
        "collision_rate": collision,
        "collision_low": 0.0,
        "collision_high": collision + 0.02,
        "driving_time_s": None if collision else 9.04,
    }


MEASURED = {"push": measures(0.0), "yield": measures(0.03)}


def test_it_says_what_it_was_trained_on_and_what_was_measured() -> None:
    card = model_card(compose_config(["+experiment=yield", "seed=4"]), MEASURED)
    assert card.startswith("# yield, seed 4\n")
    assert "a policy trained by acktr" in card
    assert "| sees | occupancy grid |" in card
    assert "| drivers of the training | planner |" in card
    assert "| Push | 200 | 90.0 (85.0 to 94.0) | 0.0 (0.0 to 2.0) | 9.0 |" in card
    assert "| Yield | 200 | 90.0 (85.0 to 94.0) | 3.0 (0.0 to 5.0) | none |" in card


def test_it_says_what_the_policy_cannot_do() -> None:
    card = model_card(compose_config(["+experiment=yield"]), MEASURED)
    limits = card[card.index("## Limits") :]
    assert "Collisions are most frequent in yield: 3.0 %, by the interval up to 5.0 %." in limits
    assert "not trained in this run" not in limits
    clean = model_card(compose_config(["+experiment=yield"]), {"push": measures(0.0)})
    assert "No collision was seen, which by the interval still allows up to 2.0 % of the episodes." in clean


def test_of_a_policy_from_elsewhere_no_training_is_claimed(tmp_path: Path) -> None:
    run = RecordedRun(tmp_path)
    config = compose_config(["+experiment=yield", "stages=[evaluate]", "checkpoint=pretrained"])
    write_model_card(config, run, {setting: {"adaptive": values} for setting, values in MEASURED.items()})
    card = (tmp_path / "model_card.md").read_text()
    assert "It was not trained in this run" in card
    assert "drivers of the training" not in card
    assert card.endswith("## Command\n\n```\npython -m negopipe +experiment=recorded\n```\n")
    assert run.artifacts == [("model_card.md", "")]

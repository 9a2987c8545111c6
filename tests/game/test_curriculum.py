"""Where a training stands in Algorithm 1, with stages of fixed length and with stages that end early."""

import pytest
from games import MIXTURE

from negopipe.game.curriculum import AdvanceConfig, Curriculum, CurriculumConfig, CurriculumStageConfig, StartsConfig
from negopipe.game.reward import RewardConfig

STAGES = tuple(CurriculumStageConfig(name, n, MIXTURE) for name, n in (("a", 2), ("b", 3), ("c", 1)))
STARTS = StartsConfig(ego_start_distance_m=(13.0, 14.0), start_speed_mps=(4.0, 5.0))


def stages_of(curriculum: Curriculum, successes: list[bool]) -> str:
    """The stage of each iteration, if each sees these episodes end."""
    names = []
    for _ in range(curriculum.n_total):
        names.append(curriculum.stage.name)
        curriculum.finish_iteration(successes)
    return "".join(names)


@pytest.mark.parametrize("successes", [[], [True], [False] * 5])
def test_without_advance_every_stage_takes_its_iterations(successes: list[bool]) -> None:
    assert stages_of(Curriculum(CurriculumConfig(STAGES, None, STARTS, {}, None, None, 0.0)), successes) == "aabbbc"


@pytest.mark.parametrize(
    ("successes", "expected"),
    [
        ([True, True, True], "abcccc"),  # mastered at once; the last stage takes what is left
        ([True, True], "aabbcc"),  # three episodes are needed
        ([True, False, True], "abcccc"),  # two of three are enough
        ([True, False, False], "aabbbc"),
        ([], "aabbbc"),
    ],
)
def test_a_mastered_stage_ends_early(successes: list[bool], expected: str) -> None:
    advance = AdvanceConfig(success_rate=0.6, n_episodes=3)
    assert stages_of(Curriculum(CurriculumConfig(STAGES, advance, STARTS, {}, None, None, 0.0)), successes) == expected


def test_says_when_the_stage_changes() -> None:
    curriculum = Curriculum(CurriculumConfig(STAGES, None, STARTS, {}, None, None, 0.0))
    assert [curriculum.finish_iteration([]) for _ in range(6)] == [False, True, False, False, True, False]


def test_goes_on_where_it_stopped() -> None:
    config = CurriculumConfig(STAGES, AdvanceConfig(success_rate=1.0, n_episodes=4), STARTS, {}, None, None, 0.0)
    for n_before in range(6):
        whole, first, second = (Curriculum(config) for _ in range(3))
        for _ in range(n_before):
            whole.finish_iteration([True, True])
            first.finish_iteration([True, True])
        second.load_state_dict(first.state_dict())
        for _ in range(6):
            assert whole.finish_iteration([True]) == second.finish_iteration([True])
            assert whole.stage == second.stage


def test_a_stage_may_pay_otherwise() -> None:
    usual, dear = RewardConfig(-0.25, -5.0, 10.0), RewardConfig(-0.25, -50.0, 10.0)
    config = CurriculumConfig(STAGES, None, STARTS, {"a": dear}, None, None, 0.0)
    assert [config.reward(stage, usual) for stage in STAGES] == [dear, usual, usual]

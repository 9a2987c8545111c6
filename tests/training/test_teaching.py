"""Teacher and student: the teacher sees what it was trained to see; the training resumes exactly."""

from pathlib import Path

import pytest
import torch
from composed import compose_config
from torch import Tensor

from negopipe.config.root import RunConfig
from negopipe.errors import UserError
from negopipe.runtime.build import build, load_policy, save_policy
from negopipe.runtime.identity import stage_key
from negopipe.tracking.snapshots import Snapshots
from negopipe.training.training import Training

SMALL = ("+experiment=smoke", "device=cpu", "compile='off'", "policy.encoder_width=16", "policy.head_widths=[8]")
OF_TEACHER = ("+experiment=smoke", "device=cpu", "observation=objects", "policy=objects", "compile='off'")


@pytest.fixture(scope="module")
def teacher(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = compose_config(OF_TEACHER)
    path = tmp_path_factory.mktemp("teacher") / "teacher.safetensors"
    save_policy(path, build(config)[1], config, 0)
    return path


def student(teacher: Path, *overrides: str) -> RunConfig:
    wanted = f"curriculum.teacher={{checkpoint: {teacher}, until: 0.5}}"
    return compose_config([*SMALL, "observation.n_frames=5", "population/driver=[planner,self]", wanted, *overrides])


def test_the_advice_is_what_the_teacher_would_do(teacher: Path) -> None:
    training = Training(student(teacher))
    assert training._teacher is not None
    env, config = training.env, compose_config([*OF_TEACHER, "population/driver=[planner,self]"])
    training.iterate()
    advice = training._teacher()
    game, policy = build(config)[0], load_policy(teacher)
    seen = game.see_as(env.world, torch.zeros(env.n_worlds, dtype=torch.int64))
    assert torch.allclose(advice[: env.n_worlds], policy(seen)[0].softmax(-1))
    its = env.is_learning()[env.n_worlds :]
    seen = game.see_as(env.world, torch.ones(env.n_worlds, dtype=torch.int64))
    assert torch.allclose(advice[env.n_worlds :], policy(seen)[0].softmax(-1) * its[:, None])
    assert its.any()


def test_the_teacher_is_asked_in_the_first_share_of_the_training(teacher: Path) -> None:
    training = Training(student(teacher))
    asked: list[float] = []
    assert training._teacher is not None
    teacher = training._teacher

    def counted() -> Tensor:
        asked.append(training.n_done / training.n_total)
        return teacher()

    training._teacher = counted  # type: ignore[assignment]
    while training.n_done < training.n_total:
        training.iterate()
    iterations = [n / training.n_total for n in range(training.n_total) if n / training.n_total < 0.5]
    assert asked == [progress for progress in iterations for _ in range(training.n_steps)]


def test_a_taught_training_resumes_exactly(teacher: Path, tmp_path: Path) -> None:
    config, snapshots = student(teacher, "curriculum.stages.0.n_iterations=4"), Snapshots(tmp_path, 1)
    whole, resumed = Training(config), Training(config)
    whole.iterate()
    whole.save_to(snapshots)
    resumed.resume(snapshots)
    for training in (whole, resumed):
        training.iterate(), training.iterate()
    states = whole.policy.state_dict(), resumed.policy.state_dict()
    assert all(torch.equal(a, b) for a, b in zip(states[0].values(), states[1].values(), strict=True))


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("observation.n_frames=4", "remember at most 3 s, as observation.n_frames"),
        (
            "policy.horizons_s=[0.0,6.0]",
            "choose among policy.horizons_s = [0.0, 6.0]",
        ),
    ],
)
def test_a_teacher_that_does_not_fit_is_refused(teacher: Path, override: str, line: str) -> None:
    with pytest.raises(UserError) as error:
        Training(student(teacher, override))
    assert str(error.value).startswith(f"curriculum.teacher.checkpoint must {line}")


def test_a_training_depends_on_what_the_teacher_has_learned(teacher: Path, tmp_path: Path) -> None:
    config = compose_config([*OF_TEACHER, "seed=2"])
    other, same = tmp_path / "other.safetensors", tmp_path / "same.safetensors"
    save_policy(other, build(config)[1], config, 0)
    same.write_bytes(teacher.read_bytes())
    keys = {name: stage_key(student(path), "train") for name, path in (("a", teacher), ("b", same), ("c", other))}
    assert keys["a"] != keys["c"]
    assert stage_key(student(teacher), "streets") == stage_key(student(teacher, "seed=1"), "streets")

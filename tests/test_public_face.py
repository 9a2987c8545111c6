"""The public face: five functions of `negopipe`, imported at their first use, typed, and enough to drive a policy."""

import importlib.util
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from mypy import api as mypy

import negopipe
from negopipe.config.compose import compose_config
from negopipe.envs.gymnasium import NarrowLaneEnv, NarrowLaneVectorEnv
from negopipe.errors import UserError
from negopipe.policy.actor_critic import Policy
from negopipe.runtime.build import build, save_policy

ROOT = Path(__file__).parent.parent

SNIPPET = """
import negopipe

env = negopipe.make_env(["+experiment=yield"])
policy = negopipe.load_policy("pretrained/yield")
grids, _ = env.reset(seed=1)
is_over = False
while not is_over:
    grids, reward, terminated, truncated, info = env.step(policy.act(grids))
    is_over = terminated or truncated
print("arrived" if info["is_success"] else "failed")
"""
"""The example of the README."""

HEAVY = ("torch", "hydra", "omegaconf", "gymnasium", "numpy", "mlflow", "pandas", "pydantic")

MISUSES = """
import negopipe

negopipe.make_env(1)
negopipe.make_vec_env("3")
negopipe.load_config(seed=1)
negopipe.load_policy(3)
negopipe.load_polisy()
reveal_type(negopipe.load_config("seed=2").seed)
reveal_type(negopipe.load_policy())
"""


def run(program: str) -> str:
    command = [sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120, cwd=ROOT).stdout


def test_importing_negopipe_imports_nothing_heavy() -> None:
    loaded = json.loads(run("import json, sys, negopipe; print(json.dumps(sorted(sys.modules)))"))
    assert not {module.partition(".")[0] for module in loaded} & set(HEAVY)


def test_the_face_is_listed_and_every_name_is_there() -> None:
    assert negopipe.__all__ == ["load_config", "load_policy", "make_env", "make_parallel_env", "make_vec_env"]
    assert set(negopipe.__all__) <= set(dir(negopipe))
    missing = {"make_parallel_env"} if importlib.util.find_spec("pettingzoo") is None else set()
    assert all(callable(getattr(negopipe, name)) for name in set(negopipe.__all__) - missing)
    with pytest.raises(AttributeError, match="module 'negopipe' has no attribute 'make_envs'"):
        _ = negopipe.make_envs  # type: ignore[attr-defined]


def test_the_example_of_the_readme_arrives(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    exec(SNIPPET, {})
    assert capsys.readouterr().out.splitlines() == ["arrived"]


def test_load_config_composes_like_the_command_line() -> None:
    assert negopipe.load_config() == compose_config()
    config = negopipe.load_config("+experiment=yield", "seed=7")
    assert (config.name, config.seed, config.evaluation.leading_setting) == ("yield", 7, "yield")
    with pytest.raises(UserError, match="seed must be a valid integer, got x"):
        negopipe.load_config("seed=x")


def test_make_env_is_what_gymnasium_makes() -> None:
    env = negopipe.make_env(["scenario.n_social=2"])
    assert isinstance(env.unwrapped, NarrowLaneEnv)
    assert env.spec is not None
    assert env.spec.kwargs["overrides"] == ["scenario.n_social=2"]
    again = gymnasium.make(env.spec)
    assert np.array_equal(env.reset(seed=3)[0], again.reset(seed=3)[0])
    with pytest.raises(UserError, match="overrides must be"):
        negopipe.make_env(["seed=2"])


def test_make_env_draws_what_render_mode_says() -> None:
    env = negopipe.make_env(render_mode="rgb_array")
    env.reset(seed=1)
    picture = env.render()
    assert isinstance(picture, np.ndarray)
    assert picture.dtype == np.uint8


def test_make_vec_env_is_one_batched_program() -> None:
    envs = negopipe.make_vec_env(3, ["perception=noisy"])
    assert isinstance(envs.unwrapped, NarrowLaneVectorEnv)
    assert envs.reset(seed=1)[0].shape == (3, 4, 84, 84)
    with pytest.raises(UserError, match="num_envs must be an integer from 1, got 0"):
        negopipe.make_vec_env(0)


def test_the_policy_drives_the_environment_and_mostly_arrives() -> None:
    n_episodes, n_worlds = 0, 24
    envs = negopipe.make_vec_env(n_worlds, ["+experiment=yield", "evaluation.settings=[yield]"])
    policy, n_arrived = negopipe.load_policy("pretrained/yield"), 0
    grids, _ = envs.reset(seed=2)
    while n_episodes < n_worlds:
        grids, _, terminated, truncated, info = envs.step(policy.act(grids))
        is_over = terminated | truncated
        n_episodes += int(is_over.sum())
        n_arrived += int(info["final_info"]["is_success"][is_over].sum()) if is_over.any() else 0
    assert n_arrived >= 0.9 * n_episodes


def test_act_takes_grids_of_the_environment_and_of_the_network() -> None:
    policy = negopipe.load_policy()
    grids, _ = negopipe.make_vec_env(5).reset(seed=1)
    assert set(np.unique(grids)) == {0, 255}
    with torch.no_grad():
        logits, _ = policy(torch.from_numpy(grids // 255))
    actions = policy.act(grids)
    assert actions.dtype == np.int64
    assert actions.tolist() == logits.argmax(-1).tolist() == policy.act(grids // 255).tolist()
    assert isinstance(policy.act(grids[0]), np.int64)
    assert policy.act(grids[0]) == actions[0]
    assert policy.act(grids[:0]).shape == (0,)
    for wrong in (grids[0, 0], grids[:, :2], 3):
        with pytest.raises(UserError, match=r"observation must be an array of shape \(4, 84, 84\)"):
            policy.act(wrong)  # type: ignore[arg-type]


def test_load_policy_builds_the_network_of_the_checkpoint(tmp_path: Path) -> None:
    config = negopipe.load_config(
        *("policy.encoder_width=32", "policy.horizons_s=[0,6]", "observation.n_cells=60", "device=cpu", "compile=off")
    )
    _, trained = build(config)
    save_policy(tmp_path / "weights", trained, config, 5)
    for policy in (
        negopipe.load_policy(tmp_path / "weights"),
        negopipe.load_policy(str(tmp_path / "weights"), config),
    ):
        assert isinstance(policy, Policy)
        assert not policy.training
        assert policy.dtype == torch.float32
        assert all(torch.equal(a, b) for a, b in zip(policy.parameters(), trained.parameters(), strict=True))


def test_load_policy_says_in_one_line_what_is_wrong(tmp_path: Path) -> None:
    config = negopipe.load_config("policy.encoder_width=32")
    (tmp_path / "text").write_text("nothing")
    for source, given, said in (
        (
            "pretrained/nix",
            None,
            "checkpoint must be among pretrained/generalist, pretrained/generalist_grids, pretrained/mixture",
        ),
        ("nix", None, "checkpoint must be an existing file, pretrained, or the id of an MLflow run"),
        (tmp_path / "text", None, "checkpoint must be a whole safetensors file"),
        ("pretrained/yield", config, "policy.encoder_width must be 512 as in the checkpoint"),
    ):
        with pytest.raises(UserError, match=said) as error:
            negopipe.load_policy(source, given)  # type: ignore[arg-type]
        assert "\n" not in str(error.value)


def test_pretrained_alone_is_the_policy_of_the_config() -> None:
    of_config = negopipe.load_policy("pretrained", negopipe.load_config("+experiment=yield"))
    named = negopipe.load_policy("pretrained/yield")
    assert all(torch.equal(a, b) for a, b in zip(of_config.parameters(), named.parameters(), strict=True))


def test_the_types_come_with_the_package() -> None:
    assert (ROOT / "negopipe" / "py.typed").is_file()
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]
    assert wheel["targets"]["wheel"]["packages"] == ["negopipe"]  # all its files, py.typed among them


@pytest.mark.slow
def test_a_users_type_checker_knows_the_face(tmp_path: Path) -> None:
    (tmp_path / "user.py").write_text(MISUSES)
    (tmp_path / "mypy.ini").write_text(f"[mypy]\nignore_missing_imports = true\nmypy_path = {ROOT}\n")
    options = ["--config-file", str(tmp_path / "mypy.ini"), "--cache-dir", str(tmp_path), "--follow-imports=silent"]
    lines = mypy.run([*options, str(tmp_path / "user.py")])[0].splitlines()
    kinds = [line.rpartition("[")[2].rstrip("]") for line in lines if ": error:" in line]
    assert kinds == ["arg-type", "arg-type", "call-arg", "arg-type", "attr-defined"]
    notes = [line for line in lines if "Revealed type" in line]
    assert "int" in notes[0]
    assert "Policy" in notes[1]

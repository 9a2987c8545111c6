"""Policies by name: found, shipped at half the size, and refused where there is none."""

import importlib.util
from pathlib import Path

import pytest
import torch
from composed import compose_config

from negopipe.errors import UserError
from negopipe.tracking import pretrained
from negopipe.tracking.checkpoint import find_checkpoint, load_checkpoint, save_checkpoint

SCRIPT = Path(__file__).parents[2] / "jobs" / "ship_policy.py"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where two policies are kept."""
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path / "pretrained")
    monkeypatch.chdir(tmp_path)
    spec = importlib.util.spec_from_file_location("ship_policy", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    weights = {"encoder.weight": torch.full((300, 300), 1 / 3), "policy_head.weight": torch.full((3,), 1 / 3)}
    save_checkpoint(tmp_path / "trained.safetensors", weights, {"decisions": 7})
    for name in ("yield", "mixture"):
        script.ship(tmp_path / "trained.safetensors", name)
    return tmp_path / "pretrained"


def test_a_shipped_policy_keeps_its_metadata_and_its_heads(folder: Path) -> None:
    tensors, metadata = load_checkpoint(folder / "yield.safetensors")
    assert metadata == {"decisions": 7}
    assert tensors["encoder.weight"].dtype == torch.bfloat16
    torch.testing.assert_close(tensors["encoder.weight"].float(), torch.full((300, 300), 1 / 3), rtol=0.004, atol=0.0)
    assert tensors["policy_head.weight"].tolist() == torch.full((3,), 1 / 3).tolist()
    small, large = ((folder / name).stat().st_size for name in ("yield.safetensors", "../trained.safetensors"))
    assert small < 0.51 * large


def test_the_experiment_names_the_policy_or_the_reference_does(folder: Path) -> None:
    config = compose_config(["+experiment=yield"])
    assert find_checkpoint("pretrained", config) == folder / "yield.safetensors"
    assert find_checkpoint("pretrained/mixture", config) == folder / "mixture.safetensors"
    with pytest.raises(UserError, match=r"among pretrained/mixture, pretrained/yield [^\n]+ got pretrained/push"):
        find_checkpoint("pretrained/push", config)


def test_a_file_of_that_name_goes_first(folder: Path) -> None:
    own = folder.parent / "pretrained" / "own.bin"
    own.write_bytes(b"")
    assert find_checkpoint("pretrained/own.bin", compose_config(["+experiment=yield"])) == Path("pretrained/own.bin")

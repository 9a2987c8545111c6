"""Exports of networks for grids and for objects: complete, the same in onnxruntime as in torch."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from games import tiny_config

from negopipe.config.root import RunConfig
from negopipe.deployment.export import export, main
from negopipe.deployment.manifest import MANIFEST_NAME, POLICY_NAME, SELFTEST_NAME, read_manifest
from negopipe.deployment.onnx_session import open_onnx
from negopipe.deployment.verify import ROWS, add_row, compare, total, verify
from negopipe.deployment.verify_decision import verify_decision
from negopipe.policy.kinds import build_policy
from negopipe.runtime.build import save_policy
from negopipe.tracking.csv_file import read_csv

pytest.importorskip("onnxscript")
pytest.importorskip("onnxruntime")

KINDS = {
    "grids": ("policy.conv=[{channels:4,kernel:8,stride:4}]", "policy.encoder_width=16", "policy.precision=float32"),
    "objects": ("observation=objects", "policy=objects", "policy.trunk_widths=[16]", "policy.own_widths=[8]"),
}
FEW = ("export.n_selftest=8", "export.n_worlds=4", "evaluation.settings=[push,yield]")


def config_of(kind: str) -> RunConfig:
    return tiny_config("yield", "evaluation/baseline=[]", "report.side_by_side=[]", *KINDS[kind], *FEW)


@pytest.fixture(scope="module", params=list(KINDS))
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[RunConfig, Path]:
    """The config and the folder of an export of an untrained network."""
    config, folder = config_of(request.param), tmp_path_factory.mktemp(request.param)
    network = build_policy(config.policy, config.observation.layout, torch.device("cpu"), torch.Generator())
    save_policy(folder / "trained.safetensors", network, config, n_decisions=0)
    export(config, folder / "trained.safetensors", folder / "export")
    return config, folder / "export"


def test_the_selftest_passes(exported: tuple[RunConfig, Path]) -> None:
    config, folder = exported
    test = np.load(folder / SELFTEST_NAME)
    logits, value = open_onnx(folder / POLICY_NAME).run(["logits", "value"], {"observation": test["observation"]})
    assert test["observation"].shape == (8, *config.observation.shape)
    np.testing.assert_allclose(logits, test["logits"], atol=1e-5)
    np.testing.assert_allclose(value, test["value"], atol=1e-5)


def test_the_batch_is_dynamic(exported: tuple[RunConfig, Path]) -> None:
    _, folder = exported
    observation = np.load(folder / SELFTEST_NAME)["observation"]
    session = open_onnx(folder / POLICY_NAME)
    for n in (1, 3, 8):
        assert session.run(["logits"], {"observation": observation[:n]})[0].shape[0] == n


def test_driven_decisions_are_the_same(exported: tuple[RunConfig, Path]) -> None:
    _, folder = exported
    parity = verify(folder, n_decisions=150)
    assert parity.is_good
    assert parity.n_decisions == sum(parity.n_by_action) == 150


def test_the_manifest_names_what_the_files_depend_on(exported: tuple[RunConfig, Path]) -> None:
    config, folder = exported
    manifest = read_manifest(folder)
    assert manifest["horizons_s"] == [0.0, 2.0, 4.0, 6.0]
    assert manifest["observation"]["kind"] == config.observation.kind
    assert manifest["versions"]["torch"] == torch.__version__
    assert json.loads((folder / MANIFEST_NAME).read_text()) == manifest


def test_another_network_differs() -> None:
    logits = torch.tensor([[1.0, 2.0], [1.0, 1.00005]])
    parity = compare(logits, np.array([[2.0, 1.0], [1.0, 0.99999]], dtype=np.float32))
    assert (parity.n_same, parity.n_ties, parity.n_by_action) == (0, 1, (0, 2))
    assert not parity.is_good


def test_the_command_says_in_a_line_what_is_wrong(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    given = ["pretrained/yield", str(tmp_path), "+experiment=yield", "policy.horizons_s=[0.0,2.0]"]
    assert main(given) == 1
    assert "policy.horizons_s must be" in capsys.readouterr().err


def test_a_row_takes_the_place_of_the_same_export(tmp_path: Path) -> None:
    logits = torch.tensor([[1.0, 2.0], [3.0, 1.0]])
    parity = compare(logits, logits.numpy())
    for name, of in {"one": parity, "two": parity}.items():
        add_row(tmp_path / "export.csv", name, of)
    add_row(tmp_path / "export.csv", "one", total([parity, parity]))
    table = read_csv(tmp_path / "export.csv", ROWS)
    assert table["export"].tolist() == ["two", "one"]
    assert table["n_same"].tolist() == [2, 4]
    assert table["n_by_action"].tolist() == ["1 1", "2 2"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "given",
    [
        ("pretrained/yield", "+experiment=yield"),
        ("pretrained/generalist", "+experiment=generalist", "safety=rss", "export.capacity.n_others=4"),  # draws
    ],
    ids=lambda given: given[0].removeprefix("pretrained/"),
)
def test_a_whole_decision_is_the_planners(given: tuple[str, ...], tmp_path: Path) -> None:
    """The graph takes minutes to write."""
    checkpoint, *overrides = given
    small = ("export.n_selftest=4", "export.n_worlds=8", "export.files=[policy,decision]")
    assert main([checkpoint, str(tmp_path), *overrides, *small]) == 0
    parity = verify_decision(tmp_path, n_decisions=80)
    assert parity.n_same_horizon == parity.n_same == parity.n_same_step == parity.n_decisions == 80

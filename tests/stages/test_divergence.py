"""Training that diverges says so at once and leaves the last good policy."""

from pathlib import Path

import pytest
import torch
from composed import compose_config
from tracked import RecordedRun

from negopipe.errors import UserError
from negopipe.learning.learner import Learner
from negopipe.learning.rollout import Rollout
from negopipe.stages import train
from negopipe.tensors.prefixes import strip_prefix
from negopipe.tracking.checkpoint import load_checkpoint

CONFIG = (
    *("+experiment=smoke", "device=cpu", "tracking.snapshot_period_s=1e-6"),
    "policy.conv=[{channels: 4, kernel: 8, stride: 4}, {channels: 4, kernel: 4, stride: 2}]",
    *("policy.encoder_width=16", "policy.head_widths=[8]"),
)
SPOILED = 4
"""The iteration after whose update something is not finite."""


@pytest.mark.parametrize(
    ("what", "value"), [("value_head.0.weight", torch.nan), ("value_head.0.weight", torch.inf), ("kl", torch.nan)]
)
def test_it_stops_with_the_last_good_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str, value: float
) -> None:
    good: list[dict[str, torch.Tensor]] = []
    update = Learner.update

    def spoiled(learner: Learner, rollout: Rollout, progress: float) -> dict[str, float]:
        good.append({name: weight.clone() for name, weight in learner.policy.state_dict().items()})
        metrics = update(learner, rollout, progress)
        if len(good) < SPOILED:
            return metrics
        if what != "kl":
            with torch.no_grad():
                learner.policy.state_dict()[what][0] = value
            return metrics
        return {**metrics, what: value}

    monkeypatch.setattr(Learner, "update", spoiled)
    with pytest.raises(UserError, match=rf"^algorithm=acktr with [^\n]+ {what} is not finite after iteration 4 of 6"):
        train.run(compose_config(list(CONFIG)), RecordedRun(tmp_path))  # type: ignore[arg-type]
    tensors, metadata = load_checkpoint(tmp_path / "checkpoint.safetensors")
    assert metadata["decisions"] == (SPOILED - 1) * 4 * 8
    assert tensors.keys() == good[-1].keys()
    assert all(torch.equal(tensors[name], weight) for name, weight in good[-1].items())
    for snapshot in (tmp_path / "snapshots").iterdir():
        weights = strip_prefix("policy", load_checkpoint(snapshot)[0])
        assert weights.keys() == good[-1].keys()
        assert all(weight.isfinite().all() for weight in weights.values())

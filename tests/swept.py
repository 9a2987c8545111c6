"""Run folders of a sweep, made up."""

import json
from pathlib import Path
from typing import Any

import yaml

from negopipe.tracking.record import RunRecord, write_record

KEYS = ["evaluation.push.adaptive.reward", "evaluation.yield.adaptive.reward"]


def make_run(outputs: Path, seed: int, rate: float, reward: float | None, /, **changes: Any) -> Path:
    """A run folder; `changes` are of the config, but for `tags` and `finished` of the record."""
    tags = {"overrides": f"+experiment=yield algorithm.rate={rate} seed={seed}", "sweep": "rates"}
    tags = changes.pop("tags", tags)
    finished = {stage: {"config": "c", "source": "s"} for stage in changes.pop("finished", ["train", "evaluate"])}
    config = {
        "name": "yield",
        "seed": seed,
        "outputs": str(outputs),
        "stages": ["train", "evaluate"],
        "objective": KEYS,
    }
    config |= {"algorithm": {"rate": rate, "gamma": 0.99}, "reward": {"kind": "paper"}, **changes}
    folder = outputs / "yield" / f"seed{seed}-{rate}-{len(list(outputs.glob('yield/*')))}"
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    write_record(folder, RunRecord("key", "s", tags, finished))
    metrics = {"evaluation": {setting: {"adaptive": {"reward": reward}} for setting in ("push", "yield")}}
    (folder / "metrics.json").write_text(json.dumps(metrics), encoding="utf-8")
    return folder

"""Files that somebody else wrote, checkpoints and YAML, run no code; nothing in the package unpickles."""

import ast
import pickle
from pathlib import Path

import pytest
from tracked import Command

import negopipe
from negopipe.config.compose import compose_config
from negopipe.errors import UserError
from negopipe.stages.evaluate import checkpoint_of
from negopipe.tracking.checkpoint import load_checkpoint

PACKAGE = Path(negopipe.__file__).parent
RUNS_CODE = {
    *("eval", "exec", "compile", "__import__"),
    *("pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"),
    *("torch.load", "pd.read_pickle", "pandas.read_pickle", "yaml.load", "yaml.unsafe_load", "os.system", "os.popen"),
    *("hydra.utils.instantiate", "hydra.utils.call", "instantiate", "get_method", "get_class"),
}

BETWEEN_RANKS = {"tensors/ranks.py": {"pickle"}}
"""The processes of one training send each other objects over connections of their own, as torch.distributed does."""


class Touch:
    """What a pickle does to whoever loads it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.touch, (self.path,)


def names_used(path: Path) -> set[str]:
    """Names that are called or imported, dotted."""
    used = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            used.add(ast.unparse(node.func))
        elif isinstance(node, ast.Import):
            used |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            used |= {node.module or "", *(alias.name for alias in node.names)}
    return used


def test_no_module_loads_what_could_be_code() -> None:
    used = {str(path.relative_to(PACKAGE)): names_used(path) & RUNS_CODE for path in PACKAGE.rglob("*.py")}
    assert {path: names for path, names in used.items() if names} == BETWEEN_RANKS
    sources = {path: path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
    assert not [path for path, text in sources.items() if "allow_pickle=True" in text or "shell=True" in text]


def test_a_pickle_is_no_checkpoint_and_is_not_loaded(tmp_path: Path) -> None:
    mark, checkpoint = tmp_path / "ran", tmp_path / "checkpoint.safetensors"
    checkpoint.write_bytes(pickle.dumps(Touch(mark)))
    with pytest.raises(UserError, match="checkpoint must be a whole safetensors file"):
        load_checkpoint(checkpoint)
    assert not mark.exists()


FOREIGN = (
    "hydra: {callbacks: {x: {_target_: torch.load, f: PICKLE, weights_only: false}}}",
    "hydra: {launcher: {_target_: torch.load, f: PICKLE, weights_only: false}}",
    "hydra: {sweeper: {_target_: torch.load, f: PICKLE, weights_only: false}}",
    "hydra: {job_logging: {handlers: {x: {(): torch.load, f: PICKLE, weights_only: false}}}}",
    "hydra: {job_logging: {formatters: {x: {class: torch.load, format: PICKLE}}}}",
    "hydra: {hydra_logging: {filters: {x: {(): torch.load, f: PICKLE, weights_only: false}}}}",
    "hydra: {hydra_logging: {handlers: {x: {class: logging.StreamHandler, stream: 'ext://MARK.x'}}}}",
    "policy: {_target_: torch.load, f: PICKLE, weights_only: false}",
    "seed: !!python/object/apply:pathlib.Path.touch [MARK]",
)
SWEPT = [(yaml, ["-m"]) for yaml in FOREIGN if "callbacks" in yaml or "job_logging" in yaml or "sweeper" in yaml]


@pytest.mark.parametrize(("yaml", "mode"), [*((yaml, []) for yaml in FOREIGN), *SWEPT])
def test_a_foreign_yaml_names_no_code_to_run(command: Command, tmp_path: Path, yaml: str, mode: list[str]) -> None:
    mark, pickled = tmp_path / "ran", tmp_path / "x.pt"
    pickled.write_bytes(pickle.dumps(Touch(mark)))
    (tmp_path / "experiment").mkdir()
    text = yaml.replace("MARK", str(mark)).replace("PICKLE", str(pickled))
    (tmp_path / "experiment" / "foreign.yaml").write_text(f"# @package _global_\n{text}\n")
    arguments = [*mode, "--config-dir", str(tmp_path), "+experiment=foreign", "seed=-1", f"outputs={tmp_path}/outputs"]
    code, _, err = command(*arguments)
    assert not mark.exists()
    assert code != 0
    assert "Traceback" not in err


def test_a_path_is_a_path(tmp_path: Path) -> None:
    """What a checkpoint's path names is read, not followed as a URI or run."""
    for reference in ("models:/policy/1", "runs:/abc", "http://127.0.0.1:1/x", "$(touch x)"):
        with pytest.raises(UserError, match=r"^checkpoint must be"):
            checkpoint_of(
                compose_config([f"checkpoint='{reference}'", f"outputs={tmp_path}"]),
                type("Run", (), {"folder": tmp_path})(),
            )


def test_the_dashboard_and_the_server_listen_on_loopback() -> None:
    dashboard = (PACKAGE / "tracking" / "dashboard.py").read_text(encoding="utf-8")
    assert '"--host", "127.0.0.1"' in dashboard
    script = (PACKAGE.parent / "jobs" / "tracking_server.sh").read_text(encoding="utf-8")
    assert 'HOST="${HOST:-127.0.0.1}"' in script

"""Results that come with negopipe: policies (`checkpoint=pretrained`, or `pretrained/<name>` of another experiment) and
a table of the oracle (`evaluation.oracle=pretrained`)."""

from pathlib import Path

from negopipe.errors import UserError

FOLDER = Path(__file__).parent.parent / "pretrained"
PRETRAINED = "pretrained"


def names() -> list[str]:
    """Names of the policies."""
    return sorted(path.stem for path in FOLDER.glob("*.safetensors"))


def find_pretrained(reference: str, experiment: str) -> Path | None:
    """File of the policy that `reference` names; None if it names another checkpoint; UserError for an unknown name.

    experiment: name of the config, for a `reference` without a name
    """
    kind, _, name = reference.partition("/")
    if kind != PRETRAINED or Path(reference).is_file():
        return None
    path = FOLDER / f"{name or experiment}.safetensors"
    if not path.is_file():
        allowed = ", ".join(f"{PRETRAINED}/{known}" for known in names()) or "none yet"
        raise UserError(f"checkpoint must be among {allowed} where it begins with {PRETRAINED}, got {reference}")
    return path


def find_oracle(reference: str) -> Path:
    """The oracle.csv that `reference` names; the file need not exist."""
    return FOLDER / "oracle.csv" if reference == PRETRAINED and not Path(reference).is_file() else Path(reference)

"""What comes with negopipe: policies (`checkpoint=pretrained`, or `pretrained/<name>` of another experiment), and what
the oracle found (`evaluation.oracle=pretrained`)."""

from pathlib import Path

from negopipe.errors import UserError

FOLDER = Path(__file__).parent.parent / "pretrained"
PRETRAINED = "pretrained"


def names() -> list[str]:
    return sorted(path.stem for path in FOLDER.glob("*.safetensors"))


def find_pretrained(reference: str, experiment: str) -> Path | None:
    """The file that `reference` means, None if it means no such policy; UserError if there is none of that name.

    experiment: the name of the config, which is meant where `reference` names none
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
    """The oracle.csv that `reference` means; the file need not be there."""
    return FOLDER / "oracle.csv" if reference == PRETRAINED and not Path(reference).is_file() else Path(reference)

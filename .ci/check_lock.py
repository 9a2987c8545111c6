"""Are the dependencies locked? Compares .ci/requirements.lock with pyproject.toml and with what is installed.

The lock names the exact version of every package that negopipe and its extras bring with them, and `make setup`
installs no other. `--write` (make lock) makes it anew from what pip would install today.
"""

import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
LOCK = ROOT / ".ci" / "requirements.lock"
PIN = re.compile(r"([a-z0-9-]+)==([0-9][A-Za-z0-9.!]*)")


def locked(text: str) -> tuple[dict[str, str], list[str]]:
    """Version by name, and what is wrong with the file itself."""
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    pins = [match.groups() for line in lines if (match := PIN.fullmatch(line))]
    wrong = [f"{line}: is no pin of the form name==version" for line in lines if not PIN.fullmatch(line)]
    names = [name for name, _ in pins]
    wrong += [f"{name}: is there twice" for name in sorted({name for name in names if names.count(name) > 1})]
    return dict(pins), wrong


def declared(project: dict) -> list[Requirement]:
    """What pyproject.toml asks for, extras included."""
    texts = [*project["dependencies"], *(text for extra in project["optional-dependencies"].values() for text in extra)]
    return [Requirement(text) for text in texts]


def problems(requirements: Iterable[Requirement], pins: dict[str, str]) -> list[str]:
    """Every requirement, and every one of a package that is installed, is in the lock, at the installed version."""
    found, seen, waiting = [], set(), list(requirements)
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        if (name, *sorted(requirement.extras)) in seen:
            continue
        seen.add((name, *sorted(requirement.extras)))
        if name not in pins:
            found.append(f"{name}: is not in the lock")
        elif not requirement.specifier.contains(pins[name], prereleases=True):
            found.append(f"{name}: {requirement.specifier} is asked for, the lock has {pins[name]}")
        try:
            package = distribution(name)
        except PackageNotFoundError:  # of an extra that is not installed
            continue
        version = package.version.partition("+")[0]  # 2.13.0+cpu is a build of 2.13.0
        if name in pins and version != pins[name]:
            found.append(f"{name}: {version} is installed, the lock has {pins[name]}")
            continue  # and asks for other things
        parts = [Requirement(text) for text in package.requires or ()]
        environments = [{"extra": extra} for extra in ("", *requirement.extras)]
        waiting += [p for p in parts if p.marker is None or any(p.marker.evaluate(each) for each in environments)]
    return sorted(set(found))


def write(project: dict) -> None:
    """Let pip resolve everything at once, as if nothing were installed."""
    wanted = [str(requirement) for requirement in declared(project)]
    options = ["--dry-run", "--ignore-installed", "--quiet", "--disable-pip-version-check", "--report", "-"]
    command = [sys.executable, "-m", "pip", "install", *options, *wanted]
    report = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
    found = [part["metadata"] for part in report["install"]]
    pins = {canonicalize_name(part["name"]): part["version"].partition("+")[0] for part in found}
    lines = [f"{name}=={version}" for name, version in sorted(pins.items())]
    LOCK.write_text("# written by make lock\n" + "\n".join(lines) + "\n", encoding="utf-8")


def main() -> int:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    if sys.argv[1:] == ["--write"]:
        write(project)
    pins, wrong = locked(LOCK.read_text(encoding="utf-8"))
    wrong += problems(declared(project), pins)
    for line in wrong:
        print(line, file=sys.stderr)
    print(f"{len(pins)} packages locked, {len(wrong)} problems")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

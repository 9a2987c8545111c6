"""The floors of the package: imports go downward only, so a part can be read without those above it."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import negopipe

PACKAGE = Path(negopipe.__file__).parent

FLOORS = (
    (
        "errors",
        "environment",
        "schema",
        "config_errors",
        "hydra_targets",
        "seeding",
        "stored",
        "nested",
        "torch_settings",
    ),
    ("simulation.state", "simulation.geometry", "tensors.stateless_rng"),
    ("simulation.reference_line", "simulation.off_road"),
    (
        "simulation.road",
        "simulation.scenario",
        "simulation.perception",
        "simulation.dynamics",
        "planner",
        "observation",
        "reward",
    ),
    ("simulation.collisions",),
    ("simulation.simulator", "simulation.starts"),
    ("chunks",),
    ("driver", "env", "learning.curriculum"),
    ("evaluation", "report", "tracking"),
    ("config", "identity"),
    ("compose",),
    ("stages", "gym_env", "sb3_adapter", "sweeping"),
    ("__main__",),
)
"""Lowest first; a name stands for a module or for a package and all in it. A floor may import itself."""

LEARNER = ("policy", "learning")
"""Beside the floors, but for what FLOORS names of them: they see tensors, and import only each other and the
lowest floor."""

FILES = sorted(path.relative_to(PACKAGE).with_suffix("") for path in PACKAGE.rglob("*.py"))
NAMES = [".".join(path.parts).removesuffix("__init__").rstrip(".") for path in FILES]


def belongs(module: str, place: str) -> bool:
    return module == place or module.startswith(f"{place}.")


def floor_of(module: str) -> int | None:
    """Height of a module; None beside the floors."""
    heights = [height for height, places in enumerate(FLOORS) if any(belongs(module, p) for p in places)]
    assert len(heights) <= 1, f"{module} stands on two floors"
    return heights[0] if heights else None


def is_learner(module: str) -> bool:
    return floor_of(module) is None and any(belongs(module, place) for place in LEARNER)


def imports_of(name: str) -> set[str]:
    """Modules of the package that a module imports anywhere, named without the leading `negopipe.`"""
    path = PACKAGE / name.replace(".", "/")
    source = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    imported: set[str] = set()
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name} imports relatively, which this test cannot follow"
            candidates = {f"{node.module}.{alias.name}" for alias in node.names}
            modules = {c for c in candidates if c.removeprefix("negopipe.") in NAMES}
            imported |= modules or {node.module or ""}
    return {module.removeprefix("negopipe.") for module in imported if module.startswith("negopipe.")}


@pytest.mark.parametrize("name", [name for name in NAMES if name])
def test_imports_go_downward(name: str) -> None:
    imported = imports_of(name)
    if is_learner(name):
        assert not {m for m in imported if not is_learner(m) and floor_of(m) != 0}
        return
    height = floor_of(name)
    if height is None:  # the __init__ of a package that spans floors
        assert not imported, f"{name} stands on no floor: give it one in FLOORS"
        return
    assert not {m for m in imported if not is_learner(m) and (floor_of(m) or 0) > height}
    if any(is_learner(m) for m in imported):
        assert height >= (floor_of("env") or 0), "the simulator knows nothing of the learner"


def test_there_are_no_circles() -> None:
    assert len(list(TopologicalSorter({name: imports_of(name) for name in NAMES}).static_order())) >= len(NAMES)


def test_every_floor_exists() -> None:
    places = [place for floor in FLOORS for place in floor] + list(LEARNER)
    assert not [place for place in places if place not in NAMES]

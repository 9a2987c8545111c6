"""The map in the package's docstring is true: every part stands in it, and imports go to what stands above it there."""

import ast
import re
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import negopipe

PACKAGE = Path(negopipe.__file__).parent

LOWER = {
    "benchmark.speed": "search",
    "deployment.options": "search",
    "deployment.vehicle.options": "search",
    "play.options": "search",
}
"""Modules that stand lower than their package, beside another: the root config holds their options."""

APART = {
    ("policy", "learning"): {"errors", "checks", "schema", "tensors", "policy", "learning"},
    ("simulation", "planner", "observation"): {"policy", "learning"},
}
"""The learner sees tensors only (all that it may import); the game's rules know nothing of it (what they may not)."""

FILES = sorted(path.relative_to(PACKAGE).with_suffix("") for path in PACKAGE.rglob("*.py"))
NAMES = [name for path in FILES if (name := ".".join(path.parts).removesuffix("__init__").rstrip("."))]
MAP = re.findall(r"^    (\w+) {2,}\S", (negopipe.__doc__ or "").partition("One decision")[0], flags=re.MULTILINE)
"""The parts of the package in the order of the map, lowest first."""


def part_of(module: str) -> str:
    return module.partition(".")[0]


def height(module: str) -> float:
    """Of a module in the map."""
    return MAP.index(LOWER[module]) if module in LOWER else MAP.index(part_of(module))


@cache
def imports_of(name: str) -> set[str]:
    """Modules of the package that a module imports when it runs, named without the leading `negopipe.`.

    What is imported for types alone does not count.
    """
    path = PACKAGE / name.replace(".", "/")
    source = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    tree = ast.parse(source.read_text(encoding="utf-8"))
    for_types = {
        child
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for child in ast.walk(node)
    }
    imported: set[str] = set()
    for node in ast.walk(tree):
        if node in for_types:
            continue
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name} imports relatively, which this test cannot follow"
            candidates = {f"{node.module}.{alias.name}" for alias in node.names}
            modules = {c for c in candidates if c.removeprefix("negopipe.") in NAMES}
            imported |= modules or {node.module or ""}
    return {module.removeprefix("negopipe.") for module in imported if module.startswith("negopipe.")}


def test_the_map_names_every_part_once() -> None:
    assert sorted(MAP) == sorted({part_of(name) for name in NAMES})


def test_imports_go_to_what_stands_above_in_the_map() -> None:
    upward = [
        (name, imported)
        for name in NAMES
        for imported in imports_of(name)
        if part_of(imported) != part_of(name) and height(imported) >= height(name)
    ]
    assert not upward


def test_the_learner_and_the_rules_of_the_game_do_not_know_each_other() -> None:
    (learner, may_import), (rules, may_not_import) = APART.items()
    parts = {name: {part_of(module) for module in imports_of(name)} for name in NAMES}
    assert not {name: others for name, others in parts.items() if part_of(name) in learner and others - may_import}
    assert not {name: others for name, others in parts.items() if part_of(name) in rules and others & may_not_import}


def test_there_are_no_circles() -> None:
    assert len(list(TopologicalSorter({name: imports_of(name) for name in NAMES}).static_order())) >= len(NAMES)


def test_stages_holds_stages_only() -> None:
    stages = [name for name in NAMES if name.startswith("stages.")]
    without_run = [s for s in stages if "def run(config" not in (PACKAGE / f"{s.replace('.', '/')}.py").read_text()]
    assert not without_run


def test_files_and_functions_are_short() -> None:
    texts = {file: (PACKAGE / f"{file}.py").read_text(encoding="utf-8") for file in FILES}
    assert not [file for file, text in texts.items() if text.count("\n") > 400]
    functions = [
        (file, node)
        for file, text in texts.items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    assert not [(file, node.name) for file, node in functions if (node.end_lineno or 0) - node.lineno >= 50]

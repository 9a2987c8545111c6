"""README.md and docs/: short, linked, in agreement with the raw results and with what there is."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from composed import FEW_STREETS, compose_config
from documented import (
    PAGES,
    ROOT,
    Results,
    all_commands,
    anchors,
    blocks,
    commands,
    links,
    overrides,
    results,
    unsupported,
)

from negopipe.deployment import export

DOCS = ROOT / "docs"
EXTENSION = DOCS / "_ext"
N_WORDS = 1200
FILE = re.compile(r"`((?:negopipe|conf|tests|jobs|examples)/[\w/.]+)`")
TABLES = [(page, table) for page in PAGES for table in results(page)]
PROGRAMS = [
    (page, block)
    for page in PAGES
    for block in blocks(page.read_text(encoding="utf-8"), "python")
    if re.search(r"^(import|from) ", block, flags=re.M)
]
COMPOSED = [command for command in all_commands() if overrides(command) is not None]


def named(path: Path) -> str:
    return str(path.relative_to(ROOT))


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= N_WORDS


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_lead_somewhere(page: Path) -> None:
    missing = []
    for target in links(page):
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            missing.append(target)
    assert not missing


def test_every_page_is_in_the_contents() -> None:
    text = (DOCS / "index.md").read_text(encoding="utf-8")
    listed = {line for block in blocks(text, "{toctree}") for line in block.splitlines() if re.fullmatch(r"\w+", line)}
    assert listed == {page.stem for page in DOCS.glob("*.md")} - {"index"}


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_files_that_a_page_names_are_there(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert {name for name in FILE.findall(text) if not (ROOT / name).exists()} == set()


def test_every_extension_is_named_with_its_files() -> None:
    text = (DOCS / "extending.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \[([\w ]+)\]\(#(add-an?-[\w-]+)\) \| (.*)$", text, flags=re.M)
    assert {anchor for _, anchor, _ in rows} == {
        anchor for anchor in anchors(DOCS / "extending.md") if "add-" in anchor
    }
    assert [name for name, _, files in rows if len(FILE.findall(files)) < 2] == []


@pytest.mark.parametrize("command", COMPOSED)
def test_a_documented_command_composes(command: str) -> None:
    """With few streets where they are drawn: drawing hundreds takes seconds."""
    compose_config([*FEW_STREETS, *(overrides(command) or [])])


@pytest.mark.parametrize("command", all_commands())
def test_a_documented_command_is_one_that_there_is(command: str) -> None:
    match command.split():
        case ["make", target, *_]:
            assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.M)
        case ["python", "-m", module, *_]:
            assert importlib.util.find_spec(module)
        case ["bash" | "python", script, *_]:
            assert (ROOT / script).exists()
        case ["torchrun", *words]:
            assert importlib.util.find_spec(words[words.index("-m") + 1])
        case ["source" | "pip" | "pre-commit" | "cmake" | "build/cpp/decide" | "nvidia-cuda-mps-control", *_]:
            pass
        case words:
            assert re.match(r"[A-Z_]+=", words[0])


@pytest.mark.parametrize(("page", "table"), TABLES, ids=[named(page) for page, _ in TABLES])
def test_figures_are_those_of_the_raw_tables(page: Path, table: Results) -> None:
    assert unsupported(table) == []


def test_what_is_said_of_five_seeds_is_of_their_means() -> None:
    folder = ROOT / "jobs" / "results"
    means = pd.read_csv(folder / "unseen_means.csv").set_index("planner").drop(columns="n_cases")
    (across,) = pd.read_csv(folder / "unseen_across.csv").to_dict("records")
    seeds = means[means.index.str.fullmatch(r"generalist(_seed_\d)?")]
    assert across["n_seeds"] == len(seeds) == 5
    for statistic, told in {"mean": "", "std": "_std", "min": "_low", "max": "_high"}.items():
        expected = seeds.agg(statistic).to_dict()
        assert {name: across[name + told] for name in means} == pytest.approx(expected, rel=2e-3)


def test_the_readme_leads_with_what_was_never_met() -> None:
    unseen, mixture = results(ROOT / "README.md")
    assert [named(source) for source in unseen.sources] == [
        f"jobs/results/unseen_{name}.csv" for name in ("across", "means")
    ]
    assert (len(unseen.rows), len(mixture.rows)) == (2, 6)


def test_a_wrong_figure_is_found() -> None:
    _, table = results(ROOT / "README.md")
    wrong = {"44.8": "44.9", "-8.45": "-8.54", "98.0 to": "97.0 to", "-19.64": "-15.45"}
    for right, other in wrong.items():
        rows = [[cell.replace(right, other) for cell in row] for row in table.rows]
        assert rows != table.rows
        assert len(unsupported(Results(table.sources, table.header, rows, table.where))) == 1


@pytest.mark.parametrize(("page", "program"), PROGRAMS, ids=[named(page) for page, _ in PROGRAMS])
def test_python_of_a_page_runs(page: Path, program: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Blocks that import something; others are excerpts."""
    for module, word in {
        "stable_baselines3": "stable_baselines3",
        "pettingzoo": "make_parallel_env",
        "torchrl": "torchrl",
    }.items():
        if word in program:
            pytest.importorskip(module)
    monkeypatch.chdir(ROOT)
    if "onnxruntime" in program:
        pytest.importorskip("onnxscript")
        pytest.importorskip("onnxruntime")
        monkeypatch.chdir(tmp_path)
        few = ["export.files=[policy]", "export.n_selftest=4", "export.n_worlds=4"]
        assert export.main(["pretrained/yield", "outputs/export/yield", "+experiment=yield", *few]) == 0
    exec(compile(program, named(page), "exec"), {})


@pytest.mark.slow
def test_the_site_is_built(tmp_path: Path) -> None:
    """As `make docs` builds it: any warning fails."""
    if importlib.util.find_spec("sphinx") is None:
        pytest.skip("sphinx is not installed")
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--keep-going", "--fresh-env", "--quiet"]
    command += ["-b", "html", str(DOCS), str(tmp_path)]
    done = subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert {"index.html", "extending.html"} <= {path.name for path in tmp_path.glob("*.html")}
    assert "widest input factor" in (tmp_path / "reference" / "configuration.html").read_text(encoding="utf-8")
    assert "Fisher matrix" in (tmp_path / "reference" / "learning.html").read_text(encoding="utf-8")


def test_a_page_has_commands() -> None:
    assert commands(ROOT / "README.md")[:2] == ["make yield", "make test"]

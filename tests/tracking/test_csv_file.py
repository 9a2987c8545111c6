"""Tables as files: what is written comes back as it was, whatever it is called; what is damaged is named."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import negopipe
from negopipe.errors import UserError
from negopipe.tracking.csv_file import CsvKind, read_csv, write_csv

KIND = CsvKind("the test", {"name": str, "n": int, "share_*": float})
NAMES = ["NA", "nan", "None", "12", "1e5", "true", "", " ", 'a "b", c', "inf", "null", "N/A", "-"]
SOURCES = [
    path
    for folder in (Path(negopipe.__file__).parent, Path(__file__).parents[2] / "jobs")
    for path in folder.rglob("*.py")
    if path.name != "csv_file.py"
]


def table() -> pd.DataFrame:
    rng = np.random.default_rng(0)
    share = np.where(np.arange(len(NAMES)) % 3 == 0, np.nan, rng.random(len(NAMES)) * 10.0 ** rng.integers(-9, 9))
    return pd.DataFrame({"name": NAMES, "n": range(len(NAMES)), "share_a": share, "share_b": np.inf})


def test_what_is_written_comes_back(tmp_path: Path) -> None:
    write_csv(tmp_path / "table.csv", table(), KIND)
    found = read_csv(tmp_path / "table.csv", KIND, ["name", "n", "share_a"])
    pd.testing.assert_frame_equal(found, table())
    assert found["name"].tolist() == NAMES
    assert (tmp_path / "table.csv").read_text() == table().to_csv(index=False)
    texts = read_csv(tmp_path / "table.csv", KIND.texts)
    assert texts["n"].tolist() == [str(n) for n in range(len(NAMES))]
    write_csv(tmp_path / "again.csv", texts, KIND)
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "table.csv").read_bytes()


def test_others_may_read_a_table_as_any_other_file(tmp_path: Path) -> None:
    write_csv(tmp_path / "table.csv", table(), KIND)
    (tmp_path / "other").touch()
    assert (tmp_path / "table.csv").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_a_table_without_rows_keeps_its_types(tmp_path: Path) -> None:
    write_csv(tmp_path / "table.csv", table().head(0), KIND)
    found = read_csv(tmp_path / "table.csv", KIND)
    assert found.empty
    assert [str(found[name].dtype) for name in found] == ["str", "int64", "float64", "float64"]


def test_what_the_kind_does_not_know_is_neither_written_nor_read(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="has no column other"):
        write_csv(tmp_path / "table.csv", table().assign(other=1), KIND)
    (tmp_path / "table.csv").write_text("name,other,n\na,x,1\n")
    assert read_csv(tmp_path / "table.csv", KIND).to_dict("records") == [{"name": "a", "n": 1}]


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (b"", "must be a table as the test writes it, got an empty file"),
        (b"\n\n", "got an empty file"),
        (b"name,share_a\na,1\n", "must have a column n as the test writes it, got name, share_a"),
        (b"name,n,share_a\na,one,1\n", "column n, row 1: must hold whole numbers, got one"),
        (b"name,n,share_a\na,1.5,1\n", "column n, row 1: must hold whole numbers, got 1.5"),
        (b"name,n,share_a\na,,1\n", "column n, row 1: must hold whole numbers, got an empty cell"),
        (b"name,n,share_a\na,1,1\nb,2,x\n", "column share_a, row 2: must hold numbers, got x"),
        (b"name,n,share_a\na,1,1\nb,2\n", "row 2 must have 3 columns as the header has, got 2"),
        (b"name,n,share_a\na,1,1,9\n", "row 1 must have 3 columns as the header has, got 4"),
        (b'name,n,share_a\n"a,1,1\n', "must be a table as the test writes it (unexpected end of data)"),
        (b"name,n,share_a\n\xff,1,1\n", "must be a table as the test writes it ('utf-8' codec can't decode"),
        (None, "no such file; the test writes it"),
    ],
)
def test_a_damaged_file_is_named_in_one_line(tmp_path: Path, content: bytes | None, line: str) -> None:
    path = tmp_path / "table.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError) as error:
        read_csv(path, KIND, ["name", "n"])
    assert str(error.value).startswith(f"{path}: ")
    assert line in str(error.value)
    assert "\n" not in str(error.value)


def test_nobody_reads_or_writes_tables_otherwise() -> None:
    otherwise = re.compile(r"pd\.read_csv|\.to_csv\(|^import csv", flags=re.M)
    assert not [path for path in SOURCES if otherwise.search(path.read_text(encoding="utf-8"))]

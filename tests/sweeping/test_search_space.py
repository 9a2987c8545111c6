"""Hydra's sweep syntax as distributions of Optuna."""

from typing import Any

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from negopipe.errors import UserError
from negopipe.sweeping.search_space import as_overrides, first_point, split_overrides

distributions = pytest.importorskip("optuna.distributions")
Float, Int, Choice = (getattr(distributions, f"{kind}Distribution") for kind in ("Float", "Int", "Categorical"))


def split(*overrides: str) -> tuple[list[str], dict[str, Any]]:
    return split_overrides(OverridesParser.create().parse_overrides(list(overrides)))


@pytest.mark.parametrize(
    ("sweep", "expected"),
    [
        ("interval(0.05,0.5)", Float(0.05, 0.5)),
        ("interval(1,5)", Float(1.0, 5.0)),
        ("tag(log,interval(1e-4,1e-2))", Float(1e-4, 1e-2, log=True)),
        ("int(interval(1,5))", Int(1, 5)),
        ("tag(int,interval(1,5))", Int(1, 5)),
        ("tag(log,int,interval(1,100))", Int(1, 100, log=True)),
        ("range(1,10)", Int(1, 9)),
        ("range(8,33,step=8)", Int(8, 32, step=8)),
        ("range(5,1,-1)", Int(2, 5)),
        ("range(0.1,0.5,0.1)", Float(0.1, 0.4, step=0.1)),
        ("1,2,3", Choice(("1", "2", "3"))),
        ("choice(paper,strict)", Choice(("paper", "strict"))),
        ("choice([1,2],[3])", Choice(("[1,2]", "[3]"))),
        ("'x y','a,b'", Choice(("'x y'", "'a,b'"))),
        ("1,1,2", Choice(("1", "2"))),
        ("null,1", Choice(("null", "1"))),
    ],
)
def test_every_sweep_has_its_distribution(sweep: str, expected: Any) -> None:
    fixed, space = split("b=1", f"+a.key={sweep}")
    assert fixed == ["b=1"]
    assert space == {"+a.key": expected}


@pytest.mark.parametrize(
    ("sweep", "line"),
    [
        ("tag(fast,interval(1,2))", "a must be tagged log, int or both, got fast"),
        ("tag(log,choice(1,2))", "a must be an interval to be tagged, got tag(log,choice(1,2))"),
        ("interval(2,1)", "a must be an interval(low,high) with low <= high, got interval(2,1)"),
        ("tag(log,interval(0,1))", "a must begin greater than 0 on a logarithmic scale, got 0"),
        ("tag(log,int,interval(0,9))", "a must begin at least 1 on a logarithmic scale, got 0"),
        ("tag(int,interval(0.5,9))", "a must have whole ends to be searched as int, got interval(0.5,9)"),
        ("range(3,3)", "a must have values to search among, got range(3,3)"),
    ],
)
def test_what_makes_no_distribution_is_named(sweep: str, line: str) -> None:
    with pytest.raises(UserError) as error:
        split(f"a={sweep}")
    assert str(error.value) == line


def test_the_last_word_about_a_key_counts_and_deletions_stay() -> None:
    fixed, space = split("a=1,2", "b=interval(1,2)", "a=3", "~c", "b=interval(3,4)")
    assert fixed == ["a=3", "~c"]
    assert space == {"b": Float(3.0, 4.0)}


def test_parameters_are_read_back_as_they_were_recorded() -> None:
    params = {"a": 0.1 + 0.2, "b": 1e-5, "c": 3, "+d": "[1,2]", "e": 1 / 3}
    texts = as_overrides(params)
    assert texts == ["a=0.3", "b=1e-05", "c=3", "+d=[1,2]", "e=0.333333333333"]
    assert [o.value() for o in OverridesParser.create().parse_overrides(texts)] == [
        0.3,
        1e-5,
        3,
        [1, 2],
        0.333333333333,
    ]


def test_the_first_point_lies_in_the_space() -> None:
    space = split("a=interval(0.5,1)", "b=7,8", "c=range(2,9)")[1]
    assert first_point(space) == {"a": 0.5, "b": "7", "c": 2}

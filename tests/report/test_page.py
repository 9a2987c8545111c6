"""The page: honest headlines, one self-contained file, nothing fetched from elsewhere."""

import base64
import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import TypeAdapter, ValidationError

from negopipe.report.page import (
    Exhibit,
    Provenance,
    ReportConfig,
    Section,
    build_page,
    data_uri,
    headline,
    headlines,
    settings_in_order,
)

PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNkYPhfDwAChwGA60e6kgAAAABJRU5ErkJggg=="
)
SVG = b'<?xml version="1.0"?><svg xmlns="http://www.w3.org/2000/svg" width="1" height="1"/>'
CONF = Path(__file__).resolve().parents[2] / "conf" / "report" / "html.yaml"


def measures(success: float, collision: float, time_s: float | None, n: int = 100) -> dict[str, Any]:
    return {
        "success_rate": success,
        "collision_rate": collision,
        "timeout_rate": 1 - success - collision,
        "deadlock_rate": 0.0,
        "arrival_rate": success,
        "driving_time_s": time_s,
        "suspend_count": 1.0,
        "suspend_time_s": 2.0,
        "reward": 10 * success - 5,
        "n_episodes": n,
    }


EVALUATION = {
    "push": {"adaptive": measures(1.0, 0.0, 8.0), "fixed_0": measures(1.0, 0.0, 9.5)},
    "yield": {"adaptive": measures(0.9, 0.1, 14.0), "fixed_0": measures(0.0, 1.0, None)},
}


def make_page(name: str = "yield", leading: str = "yield") -> str:
    exhibits = [Exhibit("A figure", "Upwards is <good>.", SVG), Exhibit("A film", "Left is left.", PNG, PNG)]
    sections = [Section("First part", "What it shows.", exhibits), Section("Second part", "", [])]
    provenance = Provenance("python -m negopipe +experiment=yield", 7, "seed: 7\n", {"torch": "2.13.0"})
    return build_page(name, leading, EVALUATION, sections, provenance)


def test_page_holds_everything() -> None:
    page = make_page()
    for text in ("First part", "Second part", "What it shows.", "A figure", "A film", "seed: 7", "2.13.0"):
        assert text in page
    assert "python -m negopipe +experiment=yield" in page
    assert page.count("How to read it.") == 2


def test_the_leading_setting_comes_first() -> None:
    assert settings_in_order(EVALUATION, "yield") == ["yield", "push"]
    assert settings_in_order(EVALUATION, "push") == ["push", "yield"]
    for leading, other in (("yield", "push"), ("push", "yield")):
        page = make_page(leading=leading)
        for element in ("<caption>{}</caption>", '<p class="verdict">{}:'):
            positions = [page.index(element.format(name.capitalize())) for name in (leading, other)]
            assert positions == sorted(positions)


def test_page_is_one_file() -> None:
    page = make_page()
    links = re.findall(r'(?:src|srcset|href)="([^"]*)"', page)
    assert links
    assert all(link.startswith(("data:image/", "#")) for link in links)
    assert not re.findall(r"https?:|url\(|@import|<script|<link", page)
    assert sum(link.startswith("data:") for link in links) == 3  # figure, film, and the film's still
    assert {link[1:] for link in links if link[0] == "#"} <= set(re.findall(r'id="([^"]*)"', page))


def test_every_image_says_in_words_what_it_shows() -> None:
    for tag in re.findall(r"<img [^>]*>", make_page()):
        assert re.search(r'alt="A (figure|film)\. [^"]+"', tag)


def test_text_is_escaped() -> None:
    page = make_page(name="<script>alert(1)</script>")
    assert "<script>" not in page
    assert "Upwards is &lt;good&gt;." in page


def test_data_uris_hold_the_image() -> None:
    kind, data = data_uri(PNG).split(",")
    assert kind == "data:image/png;base64"
    assert base64.b64decode(data) == PNG
    assert data_uri(SVG).startswith("data:image/svg+xml;base64,")
    assert data_uri(b"GIF89a").startswith("data:image/gif;base64,")


def test_table_shows_units_and_marks_the_best() -> None:
    page = make_page()
    assert '<td class="best">90.0</td><td>0.0</td>' in page  # success in yield
    assert "<td>14.0</td><td>none</td>" in page  # nobody arrived: no time, and no best time
    for label in ("success [%]", "driving time of arrivals [s]", "time at rest [s]"):
        assert label in page


@pytest.mark.parametrize(
    ("ours", "theirs", "verdict"),
    [
        (measures(0.9, 0.1, 14.0), measures(0.5, 0.5, 12.0), "beats fixed 2 s by 40 points"),
        (measures(0.5, 0.1, 14.0), measures(0.9, 0.1, 12.0), "loses to fixed 2 s by 40 points"),
        (measures(0.9, 0.1, 8.0), measures(0.88, 0.1, 9.5), "as often as fixed 2 s and is 1.5 s faster"),
        (measures(0.9, 0.1, 9.5), measures(0.92, 0.0, 8.0), "as often as fixed 2 s and is 1.5 s slower"),
        (measures(1.0, 0.0, 8.0), measures(1.0, 0.0, 8.01), "as often as fixed 2 s and is as fast"),
        (measures(0.0, 1.0, None), measures(0.0, 0.5, None), "and fixed 2 s succeed equally often"),
    ],
)
def test_headline_says_who_wins(ours: dict[str, Any], theirs: dict[str, Any], verdict: str) -> None:
    text, detail = headline("push", {"adaptive": ours, "fixed_2": theirs})
    assert text.startswith("Push: the adaptive planner")
    assert verdict in text.replace("\N{NO-BREAK SPACE}", " ")
    assert f"{100 * ours['success_rate']:.1f} % success" in detail
    assert "100 episodes each" in detail


def test_headline_needs_more_than_chance() -> None:
    few = {"adaptive": measures(0.9, 0.1, 9.0, n=10), "fixed_2": measures(0.7, 0.3, 9.0, n=10)}
    many = {"adaptive": measures(0.9, 0.1, 9.0, n=500), "fixed_2": measures(0.7, 0.3, 9.0, n=500)}
    assert "beats" not in headline("push", few)[0]
    assert "beats" in headline("push", many)[0]


def test_headline_names_the_best_rival_and_does_without_one() -> None:
    rivals = {"fixed_0": measures(0.1, 0.9, 8.0), "fixed_6": measures(0.6, 0.0, 15.0)}
    text, detail = headline("yield", {"adaptive": measures(0.9, 0.1, 14.0), **rivals})
    assert "fixed 6" in text
    assert "15.0 s" in detail
    alone, _ = headline("yield", {"adaptive": measures(0.9, 0.1, None)})
    assert "never arrives" in alone


def test_config_file_is_valid_and_wrong_values_are_not() -> None:
    values = yaml.safe_load(CONF.read_text())
    adapter = TypeAdapter(ReportConfig)
    adapter.validate_json(json.dumps(values), strict=True)
    for wrong in ({"animation_fps": 0}, {"figure_formats": ["gif"]}, {"n_animations": -1}, {"dpi": 200}):
        with pytest.raises(ValidationError):
            adapter.validate_json(json.dumps(values | wrong), strict=True)


def test_first_headline_is_about_all_settings() -> None:
    evaluation = {
        "yield": {
            "adaptive": measures(0.97, 0.0, 14.0),
            "fixed_0": measures(0.0, 1.0, None),
            "fixed_6": measures(1.0, 0.0, 14.0),
        },
        "push": {
            "adaptive": measures(1.0, 0.0, 8.0),
            "fixed_0": measures(1.0, 0.0, 8.0),
            "fixed_6": measures(0.1, 0.0, 15.0),
        },
    }
    (verdict, detail), *others = headlines(evaluation)
    assert "beats every other one" in verdict
    assert "Adaptive succeeds in at least 97.0 % of the episodes (yield)" in detail
    detail = detail.replace("\N{NO-BREAK SPACE}", " ")
    assert "; fixed 6 s succeeds in at least 10.0 % of the episodes (push)" in detail
    assert [verdict.split(":")[0] for verdict, _ in others] == ["Yield", "Push"]
    evaluation["push"]["fixed_6"] = measures(0.99, 0.0, 15.0)
    assert "does not beat" in headlines(evaluation)[0][0]
    assert len(headlines({"yield": evaluation["yield"]})) == 1

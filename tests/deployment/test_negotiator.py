"""The runtime drives as the simulator's planner with the same policy does, through messages."""

import math

import numpy as np
import pytest
from runtime_drives import GENERALIST, drive_in_simulator, drive_with_runtime, negotiator, parts, places

from negopipe.config.root import as_mapping
from negopipe.deployment.settings import Settings


@pytest.mark.parametrize(("overrides", "seed"), [((), 0), ((), 1), (("safety=rss",), 5)], ids=["0", "1", "guarded"])
def test_it_drives_as_the_simulator_does(overrides: tuple[str, ...], seed: int) -> None:
    worlds, said = drive_with_runtime(negotiator(*overrides), 30, *overrides, seed=seed)
    expected = drive_in_simulator(30, *overrides, seed=seed)
    assert len(worlds) == len(expected) > 20
    np.testing.assert_allclose(places(worlds), places(expected), atol=1e-3)
    assert {each.diagnostics.stop for each in said} == {""}
    assert {each.diagnostics.start for each in said[1:]} == {"plan"}
    assert ({each.diagnostics.intervention for each in said} > {"none"}) == bool(overrides)
    for each in said:
        assert each.diagnostics.probabilities.keys() == {0.0, 2.0, 4.0, 6.0}
        assert sum(each.diagnostics.probabilities.values()) == pytest.approx(1.0)
        if each.diagnostics.intervention == "none":
            assert max(each.diagnostics.probabilities.items(), key=lambda item: item[1])[0] == each.horizon_s


def test_an_infinite_horizon_is_read_from_an_export() -> None:
    assert Settings.of(as_mapping(parts(*GENERALIST)[0])).horizons_s == (0.0, 2.0, 4.0, 6.0, math.inf)

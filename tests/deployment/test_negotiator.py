"""The runtime drives as the simulator's planner with the same policy does, through messages."""

import numpy as np
import pytest
from runtime_drives import drive_in_simulator, drive_with_runtime, negotiator, places


@pytest.mark.parametrize(("overrides", "seed"), [((), 0), ((), 1), (("safety=rss",), 5)], ids=["0", "1", "guarded"])
def test_it_drives_as_the_simulator_does(overrides: tuple[str, ...], seed: int) -> None:
    worlds, said = drive_with_runtime(negotiator(*overrides), 30, *overrides, seed=seed)
    expected = drive_in_simulator(30, *overrides, seed=seed)
    assert len(worlds) == len(expected) > 20
    np.testing.assert_allclose(places(worlds), places(expected), atol=1e-3)
    assert {each.diagnostics.stop for each in said} == {""}
    assert {each.diagnostics.start for each in said[1:]} == {"plan"}
    assert ({each.diagnostics.intervention for each in said} > {"none"}) == bool(overrides)

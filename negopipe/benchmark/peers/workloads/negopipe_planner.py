"""negopipe's planner: one plan at a time, or many in one call."""

from collections.abc import Callable
from typing import Any

LIBRARIES = ("torch", "negopipe.planner.street_planner")
PACKAGES = ("torch",)


def start(options: dict[str, Any]) -> tuple[Callable[[], int], dict[str, Any]]:
    """Candidates of `n_plans` plans in one call, each of a car before the corridor that an oncoming one drives towards.

    options: n_plans, is_compiled
    """
    import torch

    from negopipe.planner.street_planner import StreetPlanner

    torch.set_num_threads(1)
    n = options["n_plans"]
    planner = StreetPlanner.of("narrow_lane", "frenet", is_compiled=options["is_compiled"])
    vehicles = torch.tensor([[-20.0, -1.75, 0.0, 4.8]]).repeat(n, 1)
    vehicles[1:, 0] += torch.linspace(-8.0, 8.0, max(n - 1, 0))  # no two plans are the same
    others = torch.tensor([[[22.0, 1.75, torch.pi, 5.0]]]).repeat(n, 1, 1)

    def plan() -> int:
        planner.plan(vehicles, others, horizon_s=6.0, desired_speed_mps=6.0)
        return n * planner.n_candidates

    return plan, {"n_candidates": planner.n_candidates, "n_times": len(planner.times)}

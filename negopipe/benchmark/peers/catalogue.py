"""What is compared with what: negopipe's workloads, and those of the peers with what differs between the two."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

WORKLOADS = Path(__file__).parent / "workloads"

PYTHON_ROBOTICS = "python_robotics"
"""The peer that is no package: it needs a folder."""


@dataclass(frozen=True)
class Workload:
    """Something that is measured.

    name: in tables and files
    file: its file in `workloads`, without the suffix
    unit: of its work
    options: of its start
    """

    name: str
    file: str
    unit: str
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def path(self) -> Path:
        return WORKLOADS / f"{self.file}.py"


@dataclass(frozen=True)
class Peer(Workload):
    """A workload of a peer.

    environment: name of its virtual environment
    module: what is installed where the peer is
    beside: names of negopipe's workloads that it is compared with
    differs: what is not the same on both sides
    """

    environment: str = ""
    module: str = ""
    beside: tuple[str, ...] = ()
    differs: str = ""


FLOAT32 = ("+experiment=yield", "policy=cnn_float32")
OBJECTS = ("+experiment=yield", "observation=objects", "policy=objects")
PPO = (*FLOAT32, "algorithm=ppo", "curriculum.demonstrations=null")
PLANNERS = ("planner, one plan", "planner, 1,024 plans")
WORLDS = "simulation, 200 worlds, objects"
GRIDS = ("gymnasium, 1 world, grids", "gymnasium, 64 worlds, grids", "simulation, 512 worlds, grids")

OWN = (
    Workload(PLANNERS[0], "negopipe_planner", "candidates", {"n_plans": 1, "is_compiled": True}),
    Workload(PLANNERS[1], "negopipe_planner", "candidates", {"n_plans": 1024, "is_compiled": True}),
    Workload(GRIDS[0], "negopipe_environment", "decisions", {"n_worlds": 1, "observation": "grids"}),
    Workload(GRIDS[1], "negopipe_environment", "decisions", {"n_worlds": 64, "observation": "grids"}),
    Workload(GRIDS[2], "negopipe_simulation", "decisions", {"n_worlds": 512, "overrides": FLOAT32}),
    Workload(WORLDS, "negopipe_simulation", "decisions", {"n_worlds": 200, "overrides": OBJECTS}),
    Workload("training, PPO, grids", "negopipe_training", "decisions", {"overrides": PPO}),
)

PEERS = (
    Peer(
        "frenetix",
        "frenetix",
        "candidates",
        {"with_other": True},
        environment="frenetix",
        module="frenetix",
        beside=PLANNERS,
        differs="frenetix: double precision; the oncoming car is a probability in the cost; no parked cars, no kerbs",
    ),
    Peer(
        "frenetix, nobody else",
        "frenetix",
        "candidates",
        {"with_other": False},
        environment="frenetix",
        module="frenetix",
        beside=PLANNERS,
        differs="frenetix: double precision; no other car, no parked cars, no kerbs, so it does much less",
    ),
    Peer(
        "commonroad-reactive-planner",
        "commonroad_reactive_planner",
        "candidates",
        environment="commonroad_reactive_planner",
        module="commonroad_rp",
        beside=PLANNERS,
        differs="it: double precision; 210 candidates; collisions are checked until the first free candidate only",
    ),
    Peer(
        "PythonRobotics",
        PYTHON_ROBOTICS,
        "candidates",
        environment=PYTHON_ROBOTICS,
        module="scipy",
        beside=PLANNERS,
        differs="it: double precision; the parked cars are six points, of which paths keep 2 m; nobody drives",
    ),
    Peer(
        "highway-env, grids",
        "highway_env",
        "decisions",
        {"observation": "grids"},
        environment="highway_env",
        module="highway_env",
        beside=GRIDS,
        differs="it: ten cars by rule, 1 grid of 84 x 84; negopipe: two cars that plan 216 candidates each, 4 grids",
    ),
    Peer(
        "highway-env, objects",
        "highway_env",
        "decisions",
        {"observation": "objects"},
        environment="highway_env",
        module="highway_env",
        beside=(WORLDS,),
        differs="it: ten cars by rule, one world; negopipe: two cars that plan 216 candidates each, 200 worlds",
    ),
    Peer(
        "VMAS, 200 worlds",
        "vmas",
        "decisions",
        {"n_worlds": 200},
        environment="vmas",
        module="vmas",
        beside=(WORLDS,),
        differs="it: two cars steered by their actions, no planner; negopipe: two cars that plan 216 candidates each",
    ),
    Peer(
        "MetaDrive",
        "metadrive",
        "decisions",
        environment="metadrive",
        module="metadrive",
        beside=GRIDS,
        differs="it: traffic by rule, rays; negopipe: two cars that plan 216 candidates each, 4 grids",
    ),
    Peer(
        "Stable-Baselines3 on highway-env",
        "stable_baselines3",
        "decisions",
        {"environment": str(WORKLOADS / "highway_env.py")},
        environment="stable_baselines3",
        module="stable_baselines3",
        beside=("training, PPO, grids",),
        differs="both: PPO, float32, 4 passes over each decision; it: 8 worlds, 1 grid; negopipe: 128 worlds, 4 grids",
    ),
    Peer(
        "sheeprl on highway-env",
        "sheeprl",
        "decisions",
        {"environment": str(WORKLOADS / "highway_env.py")},
        environment="sheeprl",
        module="sheeprl",
        beside=("training, PPO, grids",),
        differs="both: PPO, float32, 4 passes over each decision; it: 8 worlds, 1 grid; negopipe: 128 worlds, 4 grids",
    ),
)

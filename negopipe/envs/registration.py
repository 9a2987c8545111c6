"""The ids of the environments in gymnasium, known as soon as both packages are imported, in either order.

gymnasium has no entry points for plugins since its version 1.0. Importing negopipe therefore registers the ids, without
importing gymnasium, which takes longer than all the rest: they wait until the program imports it. Where a program
imports gymnasium only, `gymnasium.make("negopipe:negopipe/Push-v0")` imports negopipe.
"""

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType

ENV_ID = "negopipe/NarrowLane-v0"

PRESETS = {
    ENV_ID: (),
    "negopipe/Push-v0": ("+experiment=push", "evaluation.settings=[push]"),
    "negopipe/Yield-v0": ("+experiment=yield", "evaluation.settings=[yield]"),
    "negopipe/Mixture-v0": ("+experiment=mixture", "evaluation.settings=[mixture]"),
    "negopipe/Generalist-v0": (
        "+experiment=generalist",
        *("~population.drivers.self", "~population.drivers.league"),  # no policy is at hand to drive them
    ),
}
"""Overrides of the command line that make the environment of each id."""


def register_with_gymnasium() -> None:
    """Register the ids now where gymnasium is imported already, else when it is."""
    if "gymnasium" in sys.modules:
        _register(sys.modules["gymnasium"])
    else:
        sys.meta_path.insert(0, _AfterImport())


class _AfterImport:
    """Finder of modules that leaves all of them to the others, and registers the ids once gymnasium is imported."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name != "gymnasium":
            return None
        place = sys.meta_path.index(self)
        del sys.meta_path[place]
        spec = find_spec(name)
        sys.meta_path.insert(place, self)  # who asks for a spec may not import it
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module: ModuleType) -> None:
                sys.meta_path.remove(self)
                execute(module)
                _register(module)

            spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec


def _register(gymnasium: ModuleType) -> None:
    for name, preset in PRESETS.items():
        gymnasium.register(
            name,
            entry_point="negopipe.envs.gymnasium:NarrowLaneEnv",
            vector_entry_point="negopipe.envs.gymnasium:NarrowLaneVectorEnv",
            kwargs={"preset": preset},
        )

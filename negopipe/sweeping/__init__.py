"""Many runs: the objective of a sweep, a search that resumes after a stop (Optuna), the comparison of finished runs."""

import sys

_FORMER = ("summary", "seeds", "learning_curves", "comparison")
"""Modules that were commands of their own before `compare`."""


def _asked_for() -> str:
    """The module that `python -m` is about to run; empty where Python was started otherwise."""
    is_starting = sys.argv[:1] == ["-m"]  # Python replaces it by the module's path once the packages are imported
    return sys.orig_argv[sys.orig_argv.index("-m") + 1] if is_starting and "-m" in sys.orig_argv else ""


if _asked_for() in [f"{__name__}.{module}" for module in _FORMER]:
    sys.exit(f"{_asked_for()} is no command any more: python -m negopipe.sweeping.compare <outputs>/<name>, see --help")

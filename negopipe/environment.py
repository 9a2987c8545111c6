"""Environment variables, of which an empty one counts as unset, and the user's home.

The import registers two resolvers for conf/: `${negopipe.variable:NAME}` is the variable's value or null,
`${negopipe.home:path}` is the path with `~` replaced.
"""

import os

from omegaconf import OmegaConf


def variable(name: str) -> str | None:
    """The value of an environment variable; None where it is unset or empty."""
    return os.environ.get(name) or None


def default(name: str, value: str) -> None:
    """Set an environment variable that is unset or empty."""
    os.environ[name] = variable(name) or value


def drop_empty(*beginnings: str) -> None:
    """Unset empty variables whose names have one of these beginnings: libraries take an empty text for a value."""
    for name in [name for name, value in os.environ.items() if not value and name.startswith(beginnings)]:
        del os.environ[name]


def expanded(path: str) -> str:
    """The path with the user's home in the place of a leading `~` or `~name`; ValueError if there is no such user."""
    full = os.path.expanduser(path)
    if full.startswith("~"):
        raise ValueError("must begin with the name of a user where it begins with ~")
    return full


OmegaConf.register_new_resolver("negopipe.variable", variable, replace=True)
OmegaConf.register_new_resolver("negopipe.home", lambda path: os.path.expanduser(str(path)), replace=True)

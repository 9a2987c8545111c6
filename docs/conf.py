"""Sphinx builds the documentation with this: `make docs`."""

import dataclasses
import importlib.util
import inspect
import sys
import tomllib
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE / "_ext")]

import api_pages  # noqa: E402
import config_pages  # noqa: E402
import docstrings  # noqa: E402
from pydantic.fields import FieldInfo  # noqa: E402
from sphinx.application import Sphinx  # noqa: E402
from sphinx.errors import ExtensionError  # noqa: E402

project = "negopipe"
author = "The negopipe authors"
copyright = f"2026, {author}"
release = tomllib.loads((HERE.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
highlight_language = "bash"
default_role = "literal"
smartquotes = False
add_module_names = False

myst_heading_anchors = 3
myst_enable_extensions = ["dollarmath"]

autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False
autodoc_typehints_format = "short"
EXTRAS = ("stable_baselines3", "pettingzoo", "rosbags", "mcap", "cyclonedds")
autodoc_mock_imports = [name for name in EXTRAS if importlib.util.find_spec(name) is None]
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100

nitpicky = True
nitpick_ignore_regex = [
    (r"py:.*", r"(?!negopipe\b).*"),  # other packages have sites of their own
    (r"py:.*", r"negopipe\.(.*\.)?(_\w+|[A-Z])"),  # private names and type variables have no entry
]

html_theme = "furo"
html_title = "negopipe"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False

FieldInfo.__repr__ = lambda self: "..."  # type: ignore[method-assign]
"""Bounds are told where a type is declared, not in every signature that has it."""


def setup(app: Sphinx) -> None:
    app.connect("builder-inited", write_reference)
    app.connect("autodoc-process-docstring", docstring_as_rst)
    app.connect("autodoc-process-signature", signature)
    app.connect("html-page-context", without_navigation, priority=400)  # before the theme's own


def write_reference(app: Sphinx) -> None:
    """The pages that are made of the code and of conf/; a key without an explanation fails the build."""
    if missing := config_pages.undocumented():
        raise ExtensionError(f"conf/ must explain every key by a comment, got none for {', '.join(missing)}")
    api_pages.write(HERE / "reference")
    config_pages.write(HERE / "reference" / "configuration.rst")


def docstring_as_rst(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    bases = docstrings.bases(obj) if inspect.isclass(obj) else []
    lines[:] = docstrings.as_rst(lines, docstrings.field_types(obj) if _is_dataclass(obj) else None) + bases


def signature(app: Sphinx, what: str, name: str, obj: Any, options: Any, own: str, returned: str) -> tuple | None:
    """Fields of a dataclass stand below it with their types, so that its signature would say them twice."""
    return ("", None) if _is_dataclass(obj) else None


def without_navigation(app: Sphinx, page: str, template: str, context: dict[str, Any], tree: Any) -> None:
    """Pages of source code have no tree of pages beside them: it would take a third of the build."""
    if page.startswith("_modules/"):
        context.pop("toctree", None)


def _is_dataclass(obj: Any) -> bool:
    return inspect.isclass(obj) and dataclasses.is_dataclass(obj)

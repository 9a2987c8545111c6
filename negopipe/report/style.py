"""Colours, sizes and matplotlib settings, the same in every figure."""

import math
from collections.abc import Sequence
from typing import Any

import matplotlib
from matplotlib.colors import LinearSegmentedColormap, to_hex

from negopipe.evaluation.names import FixedHorizons
from negopipe.evaluation.trace import ADAPTIVE

ADAPTIVE_COLOR = "#00A0A0"


BASELINE_COLORS = {
    "random": "#7A7A7A",
    "give_way": "#B08D57",
    "cautious": "#B5B5B5",
    "level_k": "#5E7F5E",
    "oracle": "#8FBF3F",
}


OTHER_COLORS = tuple(BASELINE_COLORS.values())


OUTCOME_COLORS = {
    "success": "#BFD9EA",
    "collision": "#D55E00",
    "deadlock": "#3C3C3C",
    "timeout": "#A8A8A8",
    "social_collision": "#F2C14E",
}


INK, QUIET, CORRIDOR = "#222222", "#8A8A8A", "#EFEBE2"


LONGEST_HORIZON_S = 6.0


HORIZON_COLORMAP = LinearSegmentedColormap.from_list("horizon", ["#E09000", "#D64550", "#9A4FBF", "#1B1B4B"])
INFINITE_COLOR = "#0A3CFF"
"""Colour of an infinite horizon, which gives way: beyond the scale, and apart from it for all colour visions."""


WIDTH_IN = 4.4


STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.labelsize": 9,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": QUIET,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "grid.color": "#E4E4E4",
    "figure.facecolor": "white",
    "savefig.dpi": 200,
    "svg.hashsalt": "negopipe",
}


styled = matplotlib.rc_context(STYLE)
"""Decorator and context in which every figure is drawn and saved."""


def horizon_color(horizon_s: float) -> str:
    """Colour of a prediction horizon, as hex."""
    if horizon_s == math.inf:
        return to_hex(INFINITE_COLOR)
    return to_hex(HORIZON_COLORMAP(min(horizon_s / LONGEST_HORIZON_S, 1.0)))


def planner_colors(planners: Sequence[str], fixed_s: FixedHorizons) -> dict[str, str]:
    """Colour of each planner, as hex, independent of the other planners; unknown planners get the remaining muted
    colours in their order.
    """
    known = {ADAPTIVE: ADAPTIVE_COLOR, **BASELINE_COLORS}
    known |= {name: horizon_color(horizon_s) for name, horizon_s in fixed_s.items()}
    others = dict.fromkeys(name for name in planners if name not in known)
    free = [color for name, color in BASELINE_COLORS.items() if name not in planners] or [QUIET]
    known |= {name: free[i % len(free)] for i, name in enumerate(others)}
    return {name: known[name] for name in planners}

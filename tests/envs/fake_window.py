"""A backend of matplotlib whose window is a count of the pictures that were drawn."""

from matplotlib.backend_bases import FigureManagerBase
from matplotlib.backends.backend_agg import FigureCanvasAgg


class FigureCanvas(FigureCanvasAgg):
    n_drawn = 0

    def draw_idle(self, *args: object, **kwargs: object) -> None:
        type(self).n_drawn += 1


FigureManager = FigureManagerBase

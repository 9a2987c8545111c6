"""The frames of an observation: the moments of the past that it shows."""

from collections.abc import Iterator

from negopipe.checks import Problem, check_times
from negopipe.schema import PositiveFloat, PositiveInt, schema


@schema
class FramesConfig:
    """Frame f is f frame intervals ago, frame 0 is now."""

    n_frames: PositiveInt
    frame_interval_s: PositiveFloat

    def check(self, dt_s: float) -> Iterator[Problem]:
        """dt_s: control step, s."""
        yield from check_times({"observation.frame_interval_s": (self.frame_interval_s,)}, dt_s)

    def frame_stride(self, dt_s: float) -> int:
        """Control steps between two frames."""
        return max(1, round(self.frame_interval_s / dt_s))

    def history_steps(self, dt_s: float) -> int:
        """Past poses that the simulator must keep for the frames."""
        return (self.n_frames - 1) * self.frame_stride(dt_s)

"""The number by which a horizon is drawn, as the simulator makes it; NumPy and torch are not needed.

The draws of a drive are those of the simulator's episode whose key is the seed: `agents.horizon_drivers.draw_of`.
"""

ACTIONS = 0x5A17
"""`agents.horizon_drivers.ACTIONS`, which needs torch."""

_LOW_BITS = 0xFFFFFFFF


def draw(seed: int, number: int) -> float:
    """Uniform number in (0, 1) of decision `number` of a drive, from 0; a float32 holds it exactly."""
    return ((_mix(_mix(_mix(seed) + ACTIONS) + number) >> 9) + 0.5) * 2.0**-23


def _mix(number: int) -> int:
    """`tensors.stateless_rng.mix`."""
    number = (number + 0x1E3779B9) & _LOW_BITS
    for factor in (0x7FEB352D, 0x21F0AAAD):
        number = ((number ^ (number >> 16)) * factor) & _LOW_BITS
    return number ^ (number >> 15)

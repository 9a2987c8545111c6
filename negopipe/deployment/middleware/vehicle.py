"""Where the runtime's point of a vehicle lies, by the measures of Autoware's vehicle_info."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields


@dataclass(frozen=True)
class Vehicle:
    """Measures of the ego, m. Messages name the middle of the rear axle (`base_link`), the runtime the footprint's."""

    wheel_base_m: float
    front_overhang_m: float
    rear_overhang_m: float

    @property
    def length_m(self) -> float:
        return self.front_overhang_m + self.wheel_base_m + self.rear_overhang_m

    @property
    def base_to_middle_m(self) -> float:
        """Distance from the rear axle forward to the middle of the footprint."""
        return self.length_m / 2 - self.rear_overhang_m

    def as_texts(self) -> dict[str, str]:
        """For a recording."""
        return {name: repr(value) for name, value in asdict(self).items()}

    @staticmethod
    def of_texts(texts: Mapping[str, str]) -> "Vehicle":
        """The vehicle of a recording. KeyError, ValueError where there is none."""
        return Vehicle(**{field.name: float(texts[field.name]) for field in fields(Vehicle)})

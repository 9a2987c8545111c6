"""Options of the export."""

from typing import Annotated, Literal

from pydantic import Field

from negopipe.deployment.tables import Capacity
from negopipe.schema import Distinct, NonNegativeFloat, PositiveFloat, PositiveInt, PositiveMetres, schema

ExportFile = Literal["policy", "decision", "package"]


@schema
class CapacityConfig:
    """Sizes of the largest street and of the traffic that an exported decision serves."""

    reach_m: PositiveMetres
    n_narrow_places: PositiveInt
    n_parked: PositiveInt
    n_off_road: PositiveInt
    n_others: PositiveInt

    @property
    def street(self) -> Capacity:
        return Capacity(self.reach_m, self.n_narrow_places, self.n_parked, self.n_off_road)


@schema
class RuntimeConfig:
    """What the runtime takes of its inputs; `conf/export/onnx.yaml` says what each value means."""

    gap_s: PositiveFloat
    future_s: NonNegativeFloat
    jump_m: PositiveMetres
    replan_m: PositiveMetres
    aside_m: PositiveMetres


@schema
class ExportConfig:
    """`conf/export/onnx.yaml` says what each value means."""

    files: Annotated[tuple[ExportFile, ...], Field(min_length=1), Distinct]
    action: Literal["greedy", "sample"]
    processor: Literal["avx2", "native"]
    opset: PositiveInt
    n_selftest: PositiveInt
    n_decisions: PositiveInt
    n_worlds: PositiveInt
    capacity: CapacityConfig
    runtime: RuntimeConfig

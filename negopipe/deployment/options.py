"""Options of the export."""

from typing import Annotated, Literal

from pydantic import Field

from negopipe.schema import Distinct, PositiveInt, schema

ExportFile = Literal["policy"]


@schema
class ExportConfig:
    """`conf/export/onnx.yaml` says what each value means."""

    files: Annotated[tuple[ExportFile, ...], Field(min_length=1), Distinct]
    opset: PositiveInt
    n_selftest: PositiveInt
    n_decisions: PositiveInt
    n_worlds: PositiveInt

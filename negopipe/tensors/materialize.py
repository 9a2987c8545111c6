"""Values that a compiler must store."""

import torch
from torch import Tensor


def materialize(*values: Tensor) -> tuple[Tensor, ...]:
    """The same values, computed once; a compiler would otherwise compute them anew in every loop that reads them.

    A compiler stores what is viewed with explicit strides. Without one every value is stored anyway.

    values: all of one shape and dtype
    """
    if not torch.compiler.is_dynamo_compiling():
        return values
    rows = torch.stack(values).contiguous()
    return rows.as_strided(rows.shape, rows.stride()).unbind(0)

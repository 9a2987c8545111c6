"""Values that a compiler must store."""

import torch
from torch import Tensor


def materialize(*values: Tensor) -> tuple[Tensor, ...]:
    """The same values, computed once; a compiler would otherwise compute them anew in every loop that reads them.

    A compiler always stores the result of a matrix product, and a product with the identity changes nothing.

    values: finite, all of one shape and dtype
    """
    rows = torch.stack(values).flatten(1)
    kept = torch.mm(torch.eye(len(rows), dtype=rows.dtype, device=rows.device), rows)
    return kept.reshape(len(values), *values[0].shape).unbind(0)

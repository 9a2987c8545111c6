"""Random numbers as functions of a key: the same for the same task and time, whatever is computed beside them."""

import math

import torch
from torch import Tensor


def mix(number: Tensor) -> Tensor:
    """Hash of int64 numbers >= 0 into [0, 2^32), one to one below 2^32; neighbours have unlike hashes.

    Two rounds of xor-shift and multiply. Factors are below 2^31, so that no product exceeds 63 bits.
    """
    low_bits = 0xFFFFFFFF
    number = (number + 0x1E3779B9) & low_bits
    for factor in (0x7FEB352D, 0x21F0AAAD):
        number = ((number ^ (number >> 16)) * factor) & low_bits
    return number ^ (number >> 15)


def uniform(key: Tensor, channel: Tensor | int) -> Tensor:
    """Uniform numbers in (0, 1), float32, with the shape of `key`; channels are independent."""
    return ((mix(key + channel) >> 9) + 0.5) * 2.0**-23


def normals(key: Tensor, channel: int) -> tuple[Tensor, Tensor]:
    """Two independent standard normal numbers per key, float32, of channels `channel` and the next.

    Box and Muller 1958.
    """
    radius = torch.sqrt(-2 * torch.log(uniform(key, channel)))
    angle = 2 * math.pi * uniform(key, channel + 1)
    return radius * torch.cos(angle), radius * torch.sin(angle)

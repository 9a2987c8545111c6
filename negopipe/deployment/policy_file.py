"""policy.onnx: observations in, logits and values out, any number at a time."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from negopipe.deployment.onnx_file import write_onnx
from negopipe.policy.actor_critic import Policy
from negopipe.policy.grids import GridEncoder, recast

INPUT, OUTPUTS = "observation", ("logits", "value")


class PolicyModule(nn.Module):
    """A policy whose arguments have the names of the file's inputs."""

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """[E, *obs] uint8 grids or float32 rows -> logits [E, A], value [E], float32."""
        return self.policy(observation)


def exported(policy: Policy) -> Policy:
    """The policy in float32 and with maps in ONNX's order of axes."""
    is_grid = isinstance(policy.encoder, GridEncoder)
    return recast(policy, "float32", "channels_first").eval() if is_grid else policy.eval()  # type: ignore[return-value]


def write_policy(path: Path, policy: Policy, observations: Tensor, opset: int) -> None:
    """Write policy.onnx; observations: [E, *obs], E at least 2, an example of what it is given."""
    write_onnx(path, PolicyModule(policy), {INPUT: observations[:2]}, OUTPUTS, opset, batch="n")


@torch.no_grad()
def selftest(policy: Policy, observations: Tensor) -> dict[str, np.ndarray]:
    """Inputs and expected outputs of policy.onnx."""
    logits, value = policy(observations)
    return {INPUT: observations.numpy(), "logits": logits.numpy(), "value": value.numpy()}

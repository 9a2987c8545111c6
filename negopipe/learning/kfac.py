"""K-FAC: the natural gradient with a Kronecker-factored Fisher matrix.

Martens & Grosse 2015 (linear layers), Grosse & Martens 2016 (convolutions), Wu et al. 2017 (actor-critic).

Symbols, per layer (a linear layer is a convolution with one position, or with as many as there are elements that
share it, such as the other road users: K-FAC-expand, Eschenhagen et al. 2023)
    N               samples that the statistics are taken from
    S               positions of the output map
    n               inputs of one position, plus one: the homogeneous coordinate, constant 1, carries the bias
    m               outputs
    B, b            blocks of the input factor and their size, B b >= n (the last block is padded with zeros)
    a   [N, S, n]   inputs that each position sees
    d   [N, S, m]   gradient of a sample's log-likelihood of a sampled target with respect to the outputs
    A   [B, b, b]   input factor, 1/N sum_N sum_S a a^T, block-diagonal, averaged exponentially
    G   [m, m]      output factor, 1/(N S) sum_N sum_S d d^T, averaged exponentially
    F               A (x) G, this layer's block of the Fisher matrix of the mean log-likelihood
    lambda          damping
    pi              sqrt((tr A / n) / (tr G / m)), which splits the damping (Martens & Grosse 2015, Sec. 6.3)
    F_hat           (A + pi sqrt(lambda) I) (x) (G + sqrt(lambda)/pi I), the damped block
    g   [m, n]      gradient of the loss with respect to [W, bias]
    v   [m, n]      natural gradient F_hat^-1 g = (G + ..)^-1 g (A + ..)^-1
The outputs of different positions are taken as uncorrelated and alike, hence the sum over S in A and the mean
in G (Grosse & Martens 2016, Sec. 3.1).
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn

from negopipe.checks import FLOAT_BYTES, N_COPIES, N_TEMPORARIES, Memory
from negopipe.policy.actor_critic import ActorCritic, log_prob_of, sample_action
from negopipe.policy.size import Layers
from negopipe.schema import Fraction, PositiveFloat, PositiveInt, schema
from negopipe.tensors.share import WHOLE, Share

Layer = nn.Linear | nn.Conv2d
DAMPING_RETRIES = 6
"""Number of retries of a failed Cholesky factorisation, each with ten times the damping."""


@schema
class KfacConfig:
    """Quality and cost of the Fisher matrix.

    damping: lambda
    statistics_decay: weight of the old factors when new ones come in; smaller at the start
    statistics_interval: updates from one set of statistics to the next
    n_statistics: samples N of one set
    n_patches: positions that a layer's input factor is estimated from, rounded up to whole samples; the
        first convolution of the paper's network cuts 400 out of every grid
    inverse_interval: updates from one inversion to the next
    max_factor_size: input factors wider than this are split into equal diagonal blocks. The encoder's linear
        layer has 3137 inputs: as one block its inverse and its products cost more than the network itself
    """

    damping: PositiveFloat
    statistics_decay: Fraction
    statistics_interval: PositiveInt
    n_statistics: PositiveInt
    n_patches: PositiveInt
    inverse_interval: PositiveInt
    max_factor_size: PositiveInt

    def blocks(self, n: int) -> tuple[int, int]:
        """B and b of an input factor of width n: the fewest equal blocks of at most `max_factor_size`."""
        return equal_blocks(n, self.max_factor_size)

    def n_cut(self, n_positions: int) -> int:
        """Samples that the input factor of a layer with so many positions is estimated from."""
        return math.ceil(self.n_patches / n_positions)

    def memory(self, layers: Layers, n_samples: int) -> Iterator[Memory]:
        """Memory of the factors and of the patches that they are estimated from.

        n_samples: decisions of a minibatch
        """
        n_factors = 0
        for layer in layers.sizes:
            n_blocks, size = self.blocks(layer.n_inputs + 1)
            n_factors += n_blocks * size**2 + layer.n_outputs**2
        keys = ("algorithm.kfac.max_factor_size", *layers.weight_keys)
        yield Memory("the Fisher factors", n_factors * FLOAT_BYTES * N_TEMPORARIES, keys)
        n_taken = min(self.n_statistics, n_samples)
        n_numbers = 0
        for layer in layers.sizes:
            n_numbers += min(n_taken, self.n_cut(layer.n_positions)) * layer.n_positions * (layer.n_inputs + 1)
        keys = ("algorithm.kfac.n_patches", "algorithm.kfac.n_statistics", *layers.position_keys)
        yield Memory("the Fisher statistics", n_numbers * FLOAT_BYTES * N_COPIES, keys)


@dataclass(frozen=True)
class Factors:
    """A [B, b, b] and G [m, m], or their damped inverses; float32."""

    inputs: Tensor
    outputs: Tensor


class Kfac:
    """Factors and inverses of all linear and convolutional layers of a network, kept up to date."""

    def __init__(self, network: nn.Module, config: KfacConfig) -> None:
        self.config = config
        self.layers = kfac_layers(network)
        self.factors: dict[str, Factors] = {}
        self.inverses: dict[str, Factors] = {}
        self.n_updates = 0
        self.n_statistics_taken = 0
        self.n_failures = 0

    def refresh(self, fisher_loss: Callable[[int], Tensor], share: Share = WHOLE) -> None:
        """Take statistics and invert, where the schedule says so; to be called once per update; collective.

        fisher_loss: runs the network on N samples and returns -sum_N log-likelihood of targets that are sampled from
            the network's own output (targets of the data would give the empirical Fisher matrix)
        share: this rank's in the minibatch
        """
        if self.n_updates % self.config.statistics_interval == 0:
            n = self.config.n_statistics
            self._take_statistics(lambda: fisher_loss(n), share.first(n))
        if self.n_updates % self.config.inverse_interval == 0 or not self.inverses:
            self._invert()
        self.n_updates += 1

    def natural_gradient(self, gradient: dict[str, Tensor]) -> dict[str, Tensor]:
        """v = F_hat^-1 g of every layer, [m, n] float32."""
        return {name: precondition(g, self.inverses[name]) for name, g in gradient.items()}

    def gradient(self) -> dict[str, Tensor]:
        """g of every layer, [m, n] float32, from the gradients that a backward pass has left at the weights."""
        return {name: layer_gradient(layer) for name, layer in self.layers.items()}

    def set_gradient(self, gradient: dict[str, Tensor]) -> None:
        """Set the gradients of the weights to g [m, n] of every layer."""
        for name, layer in self.layers.items():
            set_layer_gradient(layer, gradient[name])

    @property
    def is_ready(self) -> bool:
        """Whether there are inverses; there are none only where every set of statistics was unusable."""
        return bool(self.inverses)

    def state_dict(self) -> dict[str, Tensor]:
        counters = torch.tensor([self.n_updates, self.n_statistics_taken, self.n_failures])
        state = {"counters": counters}
        for kind, table in (("factors", self.factors), ("inverses", self.inverses)):
            for name, factors in table.items():
                state[f"{kind}/{name}/inputs"] = factors.inputs
                state[f"{kind}/{name}/outputs"] = factors.outputs
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.n_updates, self.n_statistics_taken, self.n_failures = state["counters"].tolist()
        for kind, table in (("factors", self.factors), ("inverses", self.inverses)):
            table.clear()
            for name, layer in self.layers.items():
                if f"{kind}/{name}/inputs" in state:
                    sides = (state[f"{kind}/{name}/{side}"] for side in ("inputs", "outputs"))
                    table[name] = Factors(*(side.to(layer.weight.device) for side in sides))

    def _take_statistics(self, fisher_loss: Callable[[], Tensor], share: Share) -> None:
        inputs, output_gradients = record(self.layers, fisher_loss)
        new = {
            name: Factors(
                self._input_factor(layer, inputs[name], output_gradients[name], share),
                share.part(output_factor(layer, output_gradients[name])),
            )
            for name, layer in self.layers.items()
        }
        sides = [side for f in new.values() for side in (f.inputs, f.outputs)]
        share.add_up(sides)
        if not _is_finite(sides):
            self.n_failures += 1
            return
        decay = min(self.config.statistics_decay, 1 - 1 / (self.n_statistics_taken + 1))
        self.factors = {name: _average(self.factors.get(name), f, decay) for name, f in new.items()}
        self.n_statistics_taken += 1

    def _input_factor(self, layer: Layer, x: Tensor, d: Tensor, share: Share) -> Tensor:
        """This rank's part of A, of the first samples, which hold `n_patches` positions; of all where there is one."""
        if d.dim() > 2:
            n = self.config.n_cut(n_positions(layer, d))
            x, share = x[: share.n_first(n)], share.first(n)
        return share.part(input_factor(layer, x, self.config.max_factor_size))

    def _invert(self) -> None:
        """New inverses of all layers; a layer that cannot be inverted keeps its old one."""
        for name, factors in self.factors.items():
            inverse = damped_inverse(factors, n_inputs(self.layers[name]), self.config.damping)
            if inverse is None:
                self.n_failures += 1
                inverse = self.inverses.get(name, _identity(factors))
            self.inverses[name] = inverse


def fisher_loss(policy: ActorCritic, observation: Tensor, generator: Generator, share: Share = WHOLE) -> Tensor:
    """-sum log-likelihood of targets drawn from the network's own output; its gradients make up F.

    Actions are drawn from pi; the normalised value is the mean of a unit Gaussian.
    share: this rank's, whose observations these are
    """
    logits, value = policy(observation)
    action = share.own(sample_action(share.spread(logits.detach()), generator))
    noise = share.own(torch.randn(share.n_all(len(value)), generator=generator, device=value.device))
    target = value.detach() + policy.value_std * noise
    log_likelihood = -0.5 * ((target - value) / policy.value_std).square()
    return -(log_likelihood + log_prob_of(action, logits.log_softmax(-1))).sum()


def kfac_layers(network: nn.Module) -> dict[str, Layer]:
    """The layers that K-FAC handles, by name. Raises ValueError where a parameter is in none of them."""
    layers = {name: m for name, m in network.named_modules() if isinstance(m, nn.Linear | nn.Conv2d)}
    covered = {id(p) for layer in layers.values() for p in (layer.weight, layer.bias)}
    stray = [name for name, p in network.named_parameters() if id(p) not in covered]
    if stray or any(layer.bias is None for layer in layers.values()):
        raise ValueError(f"K-FAC handles linear and convolutional layers with a bias only, got {stray or layers}")
    return layers


def record(layers: dict[str, Layer], loss: Callable[[], Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Run `loss` and return, by layer, its input and the loss's gradient with respect to its output.

    The gradients of the weights are never formed, which saves a third of the backward pass.
    """
    inputs: dict[str, Tensor] = {}
    outputs: dict[str, Tensor] = {}

    def hook(name: str) -> Callable[[nn.Module, tuple[Tensor, ...], Tensor], None]:
        def keep(_: nn.Module, args: tuple[Tensor, ...], output: Tensor) -> None:
            inputs[name], outputs[name] = args[0].detach(), output

        return keep

    handles = [layer.register_forward_hook(hook(name)) for name, layer in layers.items()]
    try:
        gradients = torch.autograd.grad(loss(), list(outputs.values()))
    finally:
        for handle in handles:
            handle.remove()
    return inputs, dict(zip(outputs, gradients, strict=True))


def n_inputs(layer: Layer) -> int:
    """n: inputs of one position and the homogeneous coordinate."""
    return layer.weight[0].numel() + 1


def n_positions(layer: Layer, d: Tensor) -> int:
    """S: positions of the output map, from the gradient d with respect to it."""
    return math.prod(d.shape[2:] if isinstance(layer, nn.Conv2d) else d.shape[1:-1])


def homogeneous_inputs(layer: Layer, x: Tensor) -> Tensor:
    """a [N S, n] float32 from the layer's input x: [N, n - 1], [N, S, n - 1], or [N, C, H, W] cut into patches."""
    x = x.float()
    if isinstance(layer, nn.Conv2d):
        patches = F.unfold(x, layer.kernel_size, layer.dilation, layer.padding, layer.stride)  # type: ignore[arg-type]
        x = patches.transpose(1, 2)
    return F.pad(x.flatten(0, -2), (0, 1), value=1.0)


def input_factor(layer: Layer, x: Tensor, max_size: int) -> Tensor:
    """A [B, b, b] of one set of samples; x as in `homogeneous_inputs`."""
    blocks = _to_blocks(homogeneous_inputs(layer, x), max_size)
    return blocks.transpose(1, 2) @ blocks / len(x)


def output_factor(layer: Layer, d: Tensor) -> Tensor:
    """G [m, m] of one set of samples; d [N, m], [N, S, m] or [N, m, H, W], gradient of the summed loss."""
    if isinstance(layer, nn.Conv2d):
        d = d.flatten(2).transpose(1, 2)
    d = d.flatten(0, -2).float()
    return d.T @ d / len(d)


def damped_inverse(factors: Factors, n: int, damping: float) -> Factors | None:
    """Inverses of A + pi sqrt(lambda) I and G + sqrt(lambda)/pi I; None where no damping helps."""
    a_mean = factors.inputs.diagonal(dim1=1, dim2=2).sum() / n
    g_mean = factors.outputs.diagonal().mean()
    tiny = torch.finfo(torch.float32).tiny
    pi = (a_mean.clamp(min=tiny) / g_mean.clamp(min=tiny)).sqrt().clamp(1e-4, 1e4)
    for attempt in range(DAMPING_RETRIES + 1):
        root = math.sqrt(damping * 10**attempt)
        inverses = [_inverse(factors.inputs, pi * root), _inverse(factors.outputs, root / pi)]
        if _is_finite(inverses):
            return Factors(*inverses)
    return None


def precondition(gradient: Tensor, inverse: Factors) -> Tensor:
    """v = F_hat^-1 g: g [m, n] multiplied by both inverses."""
    blocks = _to_blocks(inverse.outputs @ gradient, inverse.inputs.shape[1])
    return (blocks @ inverse.inputs).transpose(0, 1).flatten(1)[:, : gradient.shape[1]]


def layer_gradient(layer: Layer) -> Tensor:
    """g [m, n] float32 from the gradients that a backward pass left at the layer's weight and bias."""
    weight, bias = layer.weight.grad, layer.bias.grad  # type: ignore[union-attr]
    return torch.cat([weight.flatten(1), bias[:, None]], dim=1)  # type: ignore[union-attr,index]


def set_layer_gradient(layer: Layer, gradient: Tensor) -> None:
    """The inverse of `layer_gradient`."""
    layer.weight.grad.copy_(gradient[:, :-1].reshape(layer.weight.shape))  # type: ignore[union-attr]
    layer.bias.grad.copy_(gradient[:, -1])  # type: ignore[union-attr]


@torch.no_grad()
def add_to_layer(layer: Layer, step: Tensor) -> None:
    """Add step [m, n] to the layer's weight and bias."""
    layer.weight.add_(step[:, :-1].reshape(layer.weight.shape))
    layer.bias.add_(step[:, -1])  # type: ignore[union-attr]


def equal_blocks(n: int, max_size: int) -> tuple[int, int]:
    """The fewest equal blocks of at most `max_size` that hold n columns: how many, and their size."""
    n_blocks = math.ceil(n / max_size)
    return n_blocks, math.ceil(n / n_blocks)


def _to_blocks(x: Tensor, max_size: int) -> Tensor:
    """Split the columns of x [M, n] into the fewest equal blocks of at most `max_size`: [B, M, b]."""
    n_blocks, size = equal_blocks(x.shape[1], max_size)
    padded = F.pad(x, (0, n_blocks * size - x.shape[1]))
    return padded.view(len(x), n_blocks, size).transpose(0, 1)


def _inverse(factor: Tensor, damping: Tensor) -> Tensor:
    """Inverse of factor + damping I, [.., b, b]; NaN where it is not positive definite."""
    eye = torch.eye(factor.shape[-1], device=factor.device)
    root, info = torch.linalg.cholesky_ex(factor + damping * eye)
    is_definite = (info == 0)[..., None, None]
    inverse = torch.cholesky_inverse(torch.where(is_definite, root, eye))  # raises where a root is singular
    return torch.where(is_definite, inverse, torch.nan).contiguous()


def _identity(factors: Factors) -> Factors:
    sides = (factors.inputs, factors.outputs)
    return Factors(*(torch.eye(side.shape[-1]).to(side).expand_as(side).contiguous() for side in sides))


def _average(old: Factors | None, new: Factors, decay: float) -> Factors:
    if old is None:
        return new
    return Factors(old.inputs.lerp(new.inputs, 1 - decay), old.outputs.lerp(new.outputs, 1 - decay))


def _is_finite(tensors: list[Tensor]) -> bool:
    return bool(torch.stack([t.sum() for t in tensors]).isfinite().all())

"""Simplicits' neural skinning weights: a small MLP trained for one object (Modi et al. 2024, doi:10.1145/3658184).

As FreeForm (section 7.2) and Kaolin run it: ELU layers of width 64 (one in, six hidden, one out), Adam at 1e-3 for
10,000 iterations, 1,000 random points and 10 random transforms of standard deviation 0.1 per iteration, in the unit
cube of the bounding box, loss

    0.1 E[ int Psi dX ] + 1e6 mean_ij (W^T W - 1)_ij^2,

the energy ramped from linear elasticity to Neo-Hookean. The deformation gradient uses exact derivatives of the network
where Kaolin takes finite differences. One constant handle is added, as there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from softmode.deformables.reduction.cache import cache_directory, fingerprint_of
from softmode.files import whole_file


@dataclass(frozen=True, kw_only=True)
class NeuralWeightsOptions:
    """How the network is trained; defaults are Kaolin's."""

    mode_count: int
    """Weights that the network has, without the constant handle."""
    iterations: int = 10_000
    """Steps of Adam."""
    layer_count: int = 6
    """Hidden layers."""
    width: int = 64
    """Neurons per layer."""
    learning_rate: float = 1.0e-3
    """Of Adam."""
    sample_count: int = 1_000
    """Random points per iteration."""
    transform_count: int = 10
    """Random handle transforms per iteration."""
    transform_deviation: float = 0.1
    """Their standard deviation, in units of the coordinates used."""
    elastic_weight: float = 0.1
    """Factor of the elastic loss."""
    orthogonality_weight: float = 1.0e6
    """Factor of the orthogonality loss."""
    unit_cube: bool = True
    """Measure the elastic energy in coordinates scaled to the unit cube per axis, as Kaolin does by default; False: in
    metres, as the equation says."""
    seed: int = 0
    """Of initialisation and sampling."""


@dataclass(frozen=True, kw_only=True)
class NeuralWeights:
    """A trained network: layers of matrices (out, in) and biases (out,)."""

    layers: list[tuple[np.ndarray, np.ndarray]]
    """Matrix and bias of each layer, float64."""
    bounds: np.ndarray
    """Bounding box that is mapped to the unit cube [m], shape (2, 3)."""
    train_seconds: float
    """Wall time of the training [s], of all objects that were trained at once."""

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> NeuralWeights:
        """Return the network of `arrays`."""
        pairs = range((len(arrays) - 2) // 2)
        found = {name: np.asarray(array, np.float64) for name, array in arrays.items()}
        layers = [(found[f"matrix_{k}"], found[f"bias_{k}"]) for k in pairs]
        return cls(layers=layers, bounds=found["bounds"], train_seconds=float(found["seconds"]))

    def arrays(self) -> dict[str, np.ndarray]:
        """Return what a file keeps."""
        found = {"bounds": self.bounds, "seconds": np.array(self.train_seconds)}
        for k, (matrix, bias) in enumerate(self.layers):
            found |= {f"matrix_{k}": matrix, f"bias_{k}": bias}
        return found

    def evaluate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return weights (N, m + 1), the constant one first, and gradients [1/m] (N, m + 1, 3) at points (N, 3) [m]."""
        size = self.bounds[1] - self.bounds[0]
        x = (np.asarray(points, dtype=np.float64) - self.bounds[0]) / size
        slope = np.broadcast_to(np.diag(1.0 / size), (len(x), 3, 3))
        for matrix, bias in self.layers[:-1]:
            z = x @ matrix.T + bias
            x = np.where(z > 0.0, z, np.expm1(np.minimum(z, 0.0)))
            slope = np.where(z > 0.0, 1.0, np.exp(np.minimum(z, 0.0)))[:, None] * (slope @ matrix.T)
        matrix, bias = self.layers[-1]
        value, gradient = x @ matrix.T + bias, (slope @ matrix.T).transpose(0, 2, 1)
        return np.pad(value, ((0, 0), (1, 0)), constant_values=1.0), np.pad(gradient, ((0, 0), (1, 0), (0, 0)))


def train_neural_weights(
    points: np.ndarray,
    volume: float,
    options: NeuralWeightsOptions,
    *,
    youngs_modulus: float,
    poissons_ratio: float,
) -> NeuralWeights:
    """Train the network on interior points, or load what the same call trained before from the cache folder.

    Args:
        points: Points that fill the object uniformly [m], shape (P, 3).
        volume: Volume [m^3].
        options: Training.
        youngs_modulus: Young's modulus [Pa].
        poissons_ratio: Poisson's ratio.

    Returns:
        The network.
    """
    key = fingerprint_of("neural weights", 2, points, volume, options, youngs_modulus, poissons_ratio)
    path = cache_directory() / "neural_weights" / f"{key}.npz"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        (network,) = train_many(
            [(points, volume)], options, youngs_modulus=youngs_modulus, poissons_ratio=poissons_ratio
        )
        with whole_file(path) as file:
            np.savez(file, allow_pickle=False, **network.arrays())
    with np.load(path) as file:
        return NeuralWeights.of(file)


def train_many(
    objects: Sequence[tuple[np.ndarray, float]],
    options: NeuralWeightsOptions,
    *,
    youngs_modulus: float,
    poissons_ratio: float,
    device: str = "cpu",
    report: Callable[[int], object] = lambda iteration: None,
) -> list[NeuralWeights]:
    """Train a network for each of several objects, all at once.

    Args:
        objects: Points that fill each uniformly [m], shape (P, 3), and its volume [m^3].
        options: Training.
        youngs_modulus: Young's modulus [Pa].
        poissons_ratio: Poisson's ratio.
        device: Of torch.
        report: Called with the number of every hundredth iteration.

    Returns:
        A network for each object.
    """
    import torch

    torch.manual_seed(options.seed)
    start = time.perf_counter()
    bounds = [np.stack([points.min(axis=0), points.max(axis=0)]) for points, _ in objects]
    count, least = options.sample_count, min(len(points) for points, _ in objects)
    mu = youngs_modulus / (2.0 * (1.0 + poissons_ratio))
    lam = youngs_modulus * poissons_ratio / ((1.0 + poissons_ratio) * (1.0 - 2.0 * poissons_ratio))
    widths = [3, *[options.width] * (options.layer_count + 1), options.mode_count]
    with torch.device(device):
        pool, size, weigh = [], [], []
        rng = np.random.default_rng(options.seed)
        for (points, volume), (lower, upper) in zip(objects, bounds, strict=True):
            rows = rng.permutation(len(points))[:least]
            pool.append(torch.tensor((points[rows] - lower) / (upper - lower), dtype=torch.float32))
            size.append(torch.tensor(np.ones(3) if options.unit_cube else upper - lower, dtype=torch.float32))
            weigh.append(volume / (float(np.prod(upper - lower)) if options.unit_cube else 1.0))
        unit, scale = torch.stack(pool), torch.stack(size)[:, None]
        volumes = torch.tensor(weigh, dtype=torch.float32)
        seed, identity = torch.diag_embed(1.0 / scale), torch.eye(options.mode_count)
        linear = [[torch.nn.Linear(a, b) for a, b in pairwise(widths)] for _ in objects]
        layers = [
            [torch.stack([getattr(own[k], part).detach() for own in linear]).requires_grad_() for part in _PARTS]
            for k in range(len(widths) - 1)
        ]
        optimizer = torch.optim.Adam([p for layer in layers for p in layer], options.learning_rate)
        each = torch.arange(len(objects))[:, None]
        for iteration in range(options.iterations):
            x = unit[each, torch.randint(least, (len(objects), count))]
            weight, slope = _forward(torch, layers, x, seed)
            shape = len(objects), options.transform_count, options.mode_count, 4, 3
            transform = options.transform_deviation * torch.randn(*shape)
            mix = iteration / options.iterations
            energy = torch.vmap(lambda w, s, x, z, mix=mix: elastic_energy(torch, w, s, x, z, mu, lam, mix))(
                weight, slope, x * scale, transform
            )
            elastic = options.elastic_weight / count * (volumes * energy.sum(dim=(1, 2))).sum()
            orthogonality = ((weight.transpose(1, 2) @ weight - identity) ** 2).mean(dim=(1, 2)).sum()
            optimizer.zero_grad()
            (elastic + options.orthogonality_weight * orthogonality).backward()
            optimizer.step()
            if iteration % 100 == 0:
                report(iteration)
        trained = [[part.detach().cpu().numpy().astype(np.float64) for part in layer] for layer in layers]
    seconds = time.perf_counter() - start
    return [
        NeuralWeights(layers=[(w[k], b[k]) for w, b in trained], bounds=bounds[k], train_seconds=seconds)
        for k in range(len(objects))
    ]


_PARTS = "weight", "bias"


def _forward(torch: Any, layers: list[Any], x: Any, seed: Any) -> tuple[Any, Any]:
    """Return weights (B, N, m) and gradients (B, N, m, 3), the derivatives carried forward through the layers.

    Args:
        torch: The module.
        layers: Matrices (B, out, in) and biases (B, out).
        x: Points in the unit cube, (B, N, 3).
        seed: Derivative of these by the place, (B, 1, 3, 3).
    """
    slope = seed.expand(*x.shape, 3)
    for matrix, bias in layers[:-1]:
        turned = matrix.transpose(1, 2)
        z = x @ turned + bias[:, None]
        x = torch.nn.functional.elu(z)
        slope = torch.exp(torch.clamp(z, max=0.0))[:, :, None] * (slope @ turned[:, None])
    matrix, bias = layers[-1]
    turned = matrix.transpose(1, 2)
    return x @ turned + bias[:, None], (slope @ turned[:, None]).transpose(2, 3)


def elastic_energy(
    torch: Any, weight: Any, slope: Any, points: Any, transform: Any, mu: float, lam: float, mix: float
) -> Any:
    """Return the energy density (N, B) of random handle transforms, ramped from linear to Neo-Hookean by `mix`.

    Args:
        torch: The module.
        weight: Weights (N, m).
        slope: Their gradients (N, m, 3).
        points: Rest positions (N, 3).
        transform: What each handle does, (B, m, 4, 3).
        mu: Shear modulus.
        lam: Lame's first parameter.
        mix: 0 to 1.
    """
    homogeneous = torch.nn.functional.pad(points, (0, 1), value=1.0)
    # d/dX_d of w_j Z_c, with Z = (X, 1): slope_jd Z_c + w_j delta_cd
    gradient = torch.einsum("njd,nc->njcd", slope, homogeneous)
    gradient = gradient + torch.einsum("nj,cd->njcd", weight, torch.eye(4)[:, :3])
    F = torch.eye(3) + torch.einsum("njcd,bjci->nbid", gradient, transform)
    return (1.0 - mix) * _linear_elastic(torch, F, mu, lam) + mix * _neo_hookean(torch, F, mu, lam)


def _linear_elastic(torch: Any, F: Any, mu: float, lam: float) -> Any:
    """Return mu |eps|^2 + lambda/2 tr(eps)^2 with eps = (F + F^T) / 2 - 1."""
    strain = 0.5 * (F + F.transpose(-1, -2)) - torch.eye(3)
    trace = strain.diagonal(dim1=-2, dim2=-1).sum(-1)
    return mu * (strain**2).sum((-1, -2)) + 0.5 * lam * trace**2


def _neo_hookean(torch: Any, F: Any, mu: float, lam: float) -> Any:
    """Return mu/2 (I_C - 3) + lambda/2 (J - 1)^2 - mu (J - 1)."""
    dilation = torch.linalg.det(F) - 1.0
    return 0.5 * mu * ((F**2).sum((-1, -2)) - 3.0) + 0.5 * lam * dilation**2 - mu * dilation

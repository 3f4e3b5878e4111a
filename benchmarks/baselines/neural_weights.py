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
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
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
    """Wall time of the training [s]."""

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
    key = fingerprint_of("neural weights", 1, points, volume, options, youngs_modulus, poissons_ratio)
    path = cache_directory() / "neural_weights" / f"{key}.npz"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        _train(points, volume, options, youngs_modulus, poissons_ratio, path)
    with np.load(path) as file:
        pairs = range((len(file.files) - 2) // 2)
        layers = [(file[f"matrix_{k}"].astype(np.float64), file[f"bias_{k}"].astype(np.float64)) for k in pairs]
        return NeuralWeights(layers=layers, bounds=file["bounds"], train_seconds=float(file["seconds"]))


def _train(
    points: np.ndarray,
    volume: float,
    options: NeuralWeightsOptions,
    youngs_modulus: float,
    poissons_ratio: float,
    path: Path,
) -> None:
    """Train and write the file."""
    import torch

    torch.manual_seed(options.seed)
    start = time.perf_counter()
    bounds = np.stack([points.min(axis=0), points.max(axis=0)])
    size = torch.tensor(bounds[1] - bounds[0], dtype=torch.float32)
    unit = torch.tensor((points - bounds[0]) / (bounds[1] - bounds[0]), dtype=torch.float32)
    if options.unit_cube:
        scale, volume = torch.ones(3), volume / float(np.prod(bounds[1] - bounds[0]))
    else:
        scale = size
    mu = youngs_modulus / (2.0 * (1.0 + poissons_ratio))
    lam = youngs_modulus * poissons_ratio / ((1.0 + poissons_ratio) * (1.0 - 2.0 * poissons_ratio))
    widths = [3, *[options.width] * (options.layer_count + 1), options.mode_count]
    layers = [torch.nn.Linear(a, b) for a, b in pairwise(widths)]
    optimizer = torch.optim.Adam([p for layer in layers for p in layer.parameters()], options.learning_rate)
    identity = torch.eye(options.mode_count)
    for iteration in range(options.iterations):
        x = unit[torch.randint(len(unit), (options.sample_count,))]
        weight, slope = _forward(torch, layers, x, torch.diag(1.0 / scale))
        transform = options.transform_deviation * torch.randn(options.transform_count, options.mode_count, 4, 3)
        mix = iteration / options.iterations
        energy = elastic_energy(torch, weight, slope, x * scale, transform, mu, lam, mix)
        elastic = options.elastic_weight * volume / len(x) * energy.sum()
        orthogonality = options.orthogonality_weight * ((weight.T @ weight - identity) ** 2).mean()
        optimizer.zero_grad()
        (elastic + orthogonality).backward()
        optimizer.step()
    arrays: dict[str, Any] = {"bounds": bounds, "seconds": np.array(time.perf_counter() - start)}
    for k, layer in enumerate(layers):
        arrays[f"matrix_{k}"], arrays[f"bias_{k}"] = layer.weight.detach().numpy(), layer.bias.detach().numpy()
    with whole_file(path) as file:
        np.savez(file, **arrays)


def _forward(torch: Any, layers: list[Any], x: Any, seed: Any) -> tuple[Any, Any]:
    """Return weights (N, m) and gradients (N, m, 3), the derivatives carried forward through the layers."""
    slope = seed.expand(len(x), 3, 3)
    for layer in layers[:-1]:
        z = layer(x)
        x = torch.nn.functional.elu(z)
        slope = torch.exp(torch.clamp(z, max=0.0))[:, None] * (slope @ layer.weight.T)
    return layers[-1](x), (slope @ layers[-1].weight.T).transpose(1, 2)


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

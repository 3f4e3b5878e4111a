"""What the FreeForm paper prints (Tables 1 to 5), for the columns beside ours."""

from __future__ import annotations

from benchmarks.accuracy import FREEFORM, MODES, SIMPLICITS

__all__ = ["FREEFORM", "FULL_ORDER", "MILLISECONDS", "MODES", "OBJECTS", "POINTS", "SIMPLICITS", "TRAINING"]

FULL_ORDER = {"MPM": {"bend": 1.42e-3, "twist": 2.34e-5}, "SPH": {"bend": 6.57e-4, "twist": 1.33e-4}}
"""Table 1: nMSE of the methods that have no number of modes."""
OBJECTS = {
    "Thingi10K": {
        "Simplicits": {"fix": (8.97e-3, 2.64e-2), "farthest": (5.58e-2, 1.66e-1), "boundary": (3.37e-2, 6.30e-2)},
        "FreeForm": {"fix": (6.87e-3, 2.14e-2), "farthest": (3.75e-2, 1.19e-1), "boundary": (3.11e-2, 5.96e-2)},
        "seconds": {"Simplicits": 121.44, "FreeForm": 3.19},
    },
    "SimReady": {
        "Simplicits": {"fix": (2.16e-9, 2.55e-9), "farthest": (9.38e-4, 2.77e-3), "boundary": (8.83e-4, 2.60e-3)},
        "FreeForm": {"fix": (1.01e-9, 1.29e-9), "farthest": (4.75e-4, 1.40e-3), "boundary": (4.16e-4, 1.26e-3)},
        "seconds": {"Simplicits": 117.45, "FreeForm": 3.49},
    },
}
"""Table 2: (MSE, Max) per boundary condition, and training time [s]."""
TRAINING = {
    ("random z", "random"): (1.58e-2, 2.50e-2, 160.12),
    ("random z", "grid"): (1.24e-2, 7.29e-3, 412.38),
    ("Hessian", "random"): (4.86e-3, 5.07e-4, 103.66),
    ("Hessian", "grid"): (4.45e-4, 3.49e-5, 145.96),
    ("eigenanalysis", "grid"): (4.10e-4, 3.46e-5, 3.93),
}
"""Table 3: nMSE of bend and twist, and time [s]. Its twist column is ten times that of Tables 1 and 4."""
POINTS = {
    "bend": {"grid": (1.53e-3, 4.10e-4), "random": (3.69e-3, 9.42e-4)},
    "twist": {"grid": (1.30e-4, 3.46e-6), "random": (3.88e-4, 1.14e-5)},
}
"""Table 4: Simplicits and FreeForm with 5,000 integration points."""
MILLISECONDS = {
    "Simplicits": {6: 5.01, 9: 3.95, 16: 5.09, 32: 10.0},
    "FreeForm": {6: 3.01, 9: 3.71, 16: 5.42, 32: 10.7},
    "FEM": 427.2,
    "MPM": 23.1,
    "SPH": 37.8,
}
"""Table 5: milliseconds per step of 0.01 s, on a GPU."""

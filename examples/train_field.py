"""A radiance field trained on forty pictures becomes a soft body, is pulled and squeezed, and is drawn.

The pictures stand for photographs: the product's camera makes them of a preset before a white wall, with a lens that
distorts, blur, noise and wrong exposure. The field is a signed distance s on a sparse grid, of density
Psi(-s / beta) / beta as in VolSDF (Yariv et al. 2021), so that it ends in walls and not in fog. One core, torch.

Run: ``python examples/train_field.py [--preset bear] [--seconds 120] [--folder out/field] [--short]``
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
import warp as wp
from PIL import Image
from scipy import ndimage
from torch.nn import functional

from softmode.objects import Placed, load
from softmode.radiance import RadianceGrid, render_radiance, write_radiance
from softmode.scenes import SplatScene
from softmode.splats import Lens, PinholeCamera, SplatArrays, SplatRasterizer, ViewArrays
from softmode.splats import orbit_poses as _  # noqa: F401
from softmode.splats import read_transforms, write_transforms

"""Gaps, normals, friction memory and energies of touching surfaces."""

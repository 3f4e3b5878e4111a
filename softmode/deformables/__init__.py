"""Reduced deformables: the build on the host, the step on the device."""

"""Gymnasium environments and the scenes they are made of."""

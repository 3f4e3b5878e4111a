"""Work that is many and independent, cut into shards: kept on the disk, done by the machines of a Ray cluster."""

from softmode.cluster.ray_tasks import run_shards
from softmode.cluster.shards import Shards

__all__ = ["Shards", "run_shards"]

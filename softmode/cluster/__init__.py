"""Work that is many and independent, cut into shards: kept on the disk, done by the machines of a Ray cluster."""

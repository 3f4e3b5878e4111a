"""What runs in the process of its own that opens OpenUSD files: limits, checks, and reading; see `usd.process`.

Nothing here imports softmode: the process starts this package alone, with usd-core.
"""

"""What runs in the process of its own that opens OpenUSD files: limits, checks, and reading.

`softmode.stages.process` starts it. Nothing here imports softmode: the process has this package alone, and usd-core.
"""

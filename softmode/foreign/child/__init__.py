"""What runs in the process of its own that reads files for libraries of others: limits, checks, and reading.

`softmode.foreign.process` starts it. Nothing here imports softmode: the process has this package alone, and the library
that a file is for (usd-core, trimesh, MuJoCo, pyarrow).
"""

"""OpenUSD files opened in a process of its own with limits; its answers are plain arrays."""

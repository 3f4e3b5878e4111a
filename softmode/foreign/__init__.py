"""Files that code of others parses, read in a process of its own with limits; its answers are plain arrays."""

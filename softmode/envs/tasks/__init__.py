"""The tasks, a folder each: task, device code, scripted policy."""
